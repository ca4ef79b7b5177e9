// Each instance is one square tile of the image; what it knows of its first candidate is the same
// for all of its pixels.

uniform sampler2D hits;
uniform sampler2D places;
uniform vec2 image_size;

in ivec3 tile;        // column and row of its first pixel, its number
in ivec2 candidates;  // the first one, and the one after the last

flat out vec4 first[3];
flat out vec4 first_place;
flat out ivec2 others;
flat out ivec4 origin;  // of the tile in the image and of its rays in their texture

void main() {
    vec2 pixel = vec2(tile.xy + TILE * ivec2(gl_VertexID & 1, gl_VertexID >> 1));
    gl_Position = vec4(2.0 * pixel / image_size - 1.0, 0.0, 1.0);
    for (int k = 0; k < 3; ++k) {
        first[k] = texelFetch(hits, hit_texel(candidates.x, k), 0);
    }
    first_place = texelFetch(places, place_texel(first[2].w), 0);
    others = ivec2(candidates.x + 1, candidates.y);
    origin = ivec4(tile.xy, TILE * TILE * (tile.z & (TILES_ROW - 1)), tile.z / TILES_ROW);
}
