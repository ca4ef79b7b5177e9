// Follows the ray of each pixel to the nearest of its tile's candidates.

uniform sampler2D hits;
uniform sampler2D places;
// Tile by tile, unit rays in camera axes and the angle (rad) that the pixel spans; 0 where nothing
// is seen.
uniform sampler2D rays;
uniform sampler2D sheet;

const float SLACK = 1e-5;        // no ray passes between two rectangles that touch
const float LEAST_COSINE = 0.1;

flat in vec4 first[3];
flat in vec4 first_place;
flat in ivec2 others;
flat in ivec4 origin;

out float grey;

vec3 met(vec4 a, vec4 b, vec4 c, vec3 ray) {
    return vec3(dot(a.xyz, ray), dot(b.xyz, ray), dot(c.xyz, ray));
}

bool within(vec3 hit) {
    float low = -SLACK * hit.x;
    float high = hit.x - low;
    return hit.y >= low && hit.y <= high && hit.z >= low && hit.z <= high;
}

// Blocks of 4x4 pixels lie together, as rasterisers work on them together.
ivec2 ray_texel() {
    ivec2 at = ivec2(gl_FragCoord.xy) - origin.xy;
    ivec2 block = at >> 2;
    ivec2 inner = at & 3;
    return origin.zw + ivec2(16 * (TILE / 4 * block.y + block.x) + 4 * inner.y + inner.x, 0);
}

void main() {
    vec4 ray = texelFetch(rays, ray_texel(), 0);
    vec3 nearest = met(first[0], first[1], first[2], ray.xyz);
    float distance = first[0].w;
    float density = first[1].w;
    vec4 place = first_place;
#if COUNT != 1
    nearest = within(nearest) ? nearest : vec3(0.0);
    float number = -1.0;
#if COUNT == 0
    int further = others.y - others.x;
#else
    const int further = COUNT - 1;  // the compiler can do without a loop
#endif
    for (int k = 0; k < further; ++k) {
        int i = others.x + k;
        vec4 a = texelFetch(hits, hit_texel(i, 0), 0);
        vec4 b = texelFetch(hits, hit_texel(i, 1), 0);
        vec4 c = texelFetch(hits, hit_texel(i, 2), 0);
        vec3 hit = met(a, b, c, ray.xyz);
        if (hit.x > nearest.x && within(hit)) {
            nearest = hit;
            distance = a.w;
            density = b.w;
            number = c.w;
        }
    }
    place = number < 0.0 ? place : texelFetch(places, place_texel(number), 0);
#endif
    // A pixel spans this many texels: its angle times the distance, more the more oblique.
    float texels = density * ray.w / nearest.x;
    float cosine = clamp(distance * nearest.x, LEAST_COSINE, 1.0);
    float level = log2(texels) - OBLIQUENESS * log2(cosine);
    vec2 texel = place.xy + place.zw * clamp(nearest.yz / nearest.x, 0.0, 1.0);
    float shade = textureLod(sheet, texel / vec2(textureSize(sheet, 0)), level).r;
    grey = ray.w > 0.0 && nearest.x > 0.0 ? shade : 0.0;
}
