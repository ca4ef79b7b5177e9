#version 330

// Tables that both shaders read, several entries in a row. They are

// hits: three texels a candidate, the rows of its map (see sim/raycast.py); beside these, the
// eye's distance from its plane (m), the texels per metre of its texture, its number;

// places: by that number, column, row, width and height of its texture in the sheet.

ivec2 hit_texel(int candidate, int row) {
    return ivec2(3 * (candidate & (HITS_ROW - 1)) + row, candidate / HITS_ROW);
}

ivec2 place_texel(float number) {
    int whole = int(number);
    return ivec2(whole & (PLACES_ROW - 1), whole / PLACES_ROW);
}
