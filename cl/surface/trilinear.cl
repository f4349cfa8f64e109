/* Marching cubes whose ambiguous faces and cells are resolved as in the trilinear field.
 *
 * References: Nielson and Hamann 1991; Chernyaev 1995, "Marching Cubes 33"; Grosso 2016.
 *
 * Passes, beside those of marching_cubes.cl, whose vertices on edges stay as they are
 *   count_cells          after count_rows: its triangles corrected, and the vertices inside cells
 *      (exclusive scan of the row counts of vertices inside cells: cl/primitives/scan.cl)
 *   make_room            vertices inside cells follow those on edges slice by slice
 *   emit_cell_triangles  in place of emit_triangles
 *   emit_cell_vertices   after emit_vertices: positions and normals of vertices inside cells
 *
 * Few cells are ambiguous, so each pass decides them again, from the voxels at their corners. */
#include "include/volume.h"
#include "surface/cell_numbers.h"
#include "include/mask_rows.h"
#include "surface/mc_tables.h"
#include "surface/trilinear_place.h"
#include "surface/vertex_group.h"

/* Entry of TRILINEAR_ROWS of cell (i, j, k) of the volume, whose case has a choice. */
static inline uint find_row(uint cell_case, const volume_part *volume, int i, int j, int k, float iso_level)
{
    return choose_row(cell_case, load_heights(volume, i, j, k, iso_level));
}

/* Active cells of a word whose case has a choice: those with a face that has two diagonal inside corners, and those
 * whose opposite corners are all alike, which a tunnel along a diagonal can join. */
static inline uint find_choices(const cell_rows *rows, uint active)
{
    const ulong a = rows->y0z0, b = rows->y1z0, c = rows->y0z1, d = rows->y1z1;
    const ulong ax = a ^ a >> 1, bx = b ^ b >> 1, cx = c ^ c >> 1, dx = d ^ d >> 1;
    const ulong across_x = (a ^ b) & (b ^ d) & (d ^ c);
    const ulong faces = (ax & bx & (a ^ b)) | (cx & dx & (c ^ d)) | (ax & cx & (a ^ c)) | (bx & dx & (b ^ d))
        | across_x | across_x >> 1;
    const ulong opposite_differ = (a ^ d >> 1) | (a >> 1 ^ d) | (b ^ c >> 1) | (b >> 1 ^ c);
    return active & (uint)(faces | ~opposite_differ);
}

/* Flag in a word's place among the vertices inside cells: the word has such vertices. */
#define HAS_CELL_VERTICES 0x8000

/* Parameters  voxels              in      slices of the volume from first_slice on
 *             mask                in      (gk, gj, words)
 *             words_with_work     in      (rows_to_count, flag_words) of count_rows
 *             row_counts          in/out  (3, rows_to_count) of count_rows: its triangles are corrected
 *             word_triangles      in/out  (rows_to_count, words) triangles of the row before each word
 *             row_cell_vertices   out     (rows_to_count,) vertices inside the cells of each row
 *             word_cell_vertices  out     (own_rows, words) vertices inside cells of the row before each word, with
 *                                         HAS_CELL_VERTICES
 *             iso_level           where on an edge the surface lies
 *             outside             value beyond the border of a closed volume
 *             ni nj nk, border    of the whole volume
 *             first_slice         slice of the volume that `voxels` begins with
 *             first_sample_slice  slice of the sample grid that the mask begins with
 *             gk, words, flag_words   as in marching_cubes.cl
 *             own_rows            rows whose cells are counted; further rows have none
 *             rows_to_count       rows of the outputs
 * Launch      global = rows_to_count rounded up by the host, any local
 * Assumes     22 (gi + 1) < 65536, so that places in a row fit 16 bits, and 6 (gi + 1) < 32768
 * Guarantees  every output is written, except the places of words without work, which nothing reads */
__kernel void count_cells(
    __global const VOXEL *restrict voxels, __global const uint *restrict mask,
    __global const uint *restrict words_with_work,
    __global uint *restrict row_counts, __global ushort *restrict word_triangles,
    __global uint *restrict row_cell_vertices, __global ushort *restrict word_cell_vertices,
    const float iso_level, const VALUE outside,
    const int ni, const int nj, const int nk, const int border, const int first_slice, const int first_sample_slice,
    const uint gk, const uint words, const uint flag_words, const uint own_rows, const uint rows_to_count)
{
    const uint row = get_global_id(0);
    if (row >= rows_to_count)
        return;
    const volume_part volume = {voxels, ni, nj, nk, first_slice, border, outside};
    const uint gi = ni + 2 * border, gj = nj + 2 * border;
    const uint j = row % gj, k = row / gj;
    const int has_cells = row < own_rows && j + 1 < gj && k + 1 < gk;
    uint more = 0, vertices = 0; /* triangles than the case table has, modulo 2^32 */
    for (uint f = 0; has_cells && f < flag_words; ++f) {
        for (uint flags = words_with_work[(size_t)row * flag_words + f]; flags != 0; flags &= flags - 1) {
            const uint w = 32 * f + lowest_bit(flags), before = vertices;
            word_triangles[(size_t)row * words + w] += (ushort)more;
            cell_rows rows;
            load_cell_rows(&rows, mask, j, k, w, gj, words);
            for (uint rest = find_choices(&rows, find_active_cells(rows, w, gi)); rest != 0; rest &= rest - 1) {
                const uint b = lowest_bit(rest), number = cell_case(rows, b);
                const uint found = find_row(number, &volume, (int)(32 * w + b) - border, (int)j - border,
                    (int)k + first_sample_slice - border, iso_level);
                more += row_triangles_of(found) - ((uint)MC_TRIANGLES[number] & 15);
                vertices += row_vertices_of(found);
            }
            word_cell_vertices[(size_t)row * words + w]
                = (ushort)(before | (vertices > before ? HAS_CELL_VERTICES : 0));
        }
    }
    row_counts[rows_to_count + row] += more;
    row_cell_vertices[row] = vertices;
}

/* Parameters  row_counts           in/out  (3, rows) of count_rows: the last row of each slice gets the vertices inside
 *                                          the slice's cells; it has no cells of its own
 *             cell_vertex_offsets  in      (rows,) vertices inside cells before each row
 *             gj, slices           rows a slice, slices; rows = gj * slices
 * Launch      global = slices rounded up by the host, any local
 * Assumes     the last slice has no vertices inside cells
 * Guarantees  the vertices of each slice are those on edges, then those inside the cells above it */
__kernel void make_room(
    __global uint *restrict row_counts, __global const uint *restrict cell_vertex_offsets, const uint gj,
    const uint slices)
{
    const uint k = get_global_id(0);
    if (k + 1 < slices)
        row_counts[(k + 1) * gj - 1] += cell_vertex_offsets[(k + 1) * gj] - cell_vertex_offsets[k * gj];
}

/* Number of the first vertex inside the cells of a row: the next slice's first, less those of the row and after it. */
static inline uint first_cell_vertex(
    __global const uint *row_offsets, __global const uint *cell_vertex_offsets, uint row, uint k, uint gj)
{
    const uint next_slice = (k + 1) * gj;
    return row_offsets[next_slice] - cell_vertex_offsets[next_slice] + cell_vertex_offsets[row];
}

/* Write the triangles of a cell by the case table; returns how many.  The shifts say where in a packed triangle its
 * first and its last corner stand. */
static inline uint write_table_cell(
    uint cell_case, const cell_numbers numbers, uint first_shift, uint last_shift, __global uint *out)
{
    const uint count = (uint)MC_TRIANGLES[cell_case] & 15;
    ulong packed = MC_TRIANGLES[cell_case] >> 4;
    for (uint n = 0; n < count; ++n, packed >>= 12, out += 3) {
        const uint corners = (uint)packed;
        out[0] = pick_number(numbers, corners >> first_shift & 15);
        out[1] = pick_number(numbers, corners >> 4 & 15);
        out[2] = pick_number(numbers, corners >> last_shift & 15);
    }
    return count;
}

/* Write the triangles of a row of TRILINEAR_ROWS; returns how many.  `cell_vertex` is the number of the cell's first
 * vertex inside. */
static inline uint write_row(uint row, const cell_numbers numbers, uint cell_vertex, int mirrored, __global uint *out)
{
    const uint count = row_triangles_of(row);
    for (uint n = 0; n < count; ++n, out += 3) {
        const uint packed = TRILINEAR_TRIANGLES[(row & 0xffff) + n];
        for (uint c = 0; c < 3; ++c) {
            const uint vertex = packed >> (5 * c) & 31;
            out[mirrored ? 2 - c : c] = vertex < CELL_VERTEX ? pick_number(numbers, vertex) : cell_vertex + vertex - CELL_VERTEX;
        }
    }
    return count;
}

/* Parameters  voxels, mask         in   as above
 *             active_words         in   (active,) numbers of the words with work
 *             row_offsets          in   (3, rows_to_count) sum of all row counts before each, after make_room
 *             cell_vertex_offsets  in   (rows_to_count,) vertices inside cells before each row
 *             word_vertices        in   (rows_to_count, words) vertices on edges of the row before each word
 *             word_triangles, word_cell_vertices   in   of count_cells
 *             triangles            out  (triangles, 3) vertex numbers, counter-clockwise as seen from lower values
 *             first_vertex         number of the slab's first vertex
 *             rows_to_count        rows that were counted
 *             mirrored             1 when index space is left-handed in mm: the winding is turned round
 *             row_shift            a word's number is its row times 2^row_shift, plus its place in the row
 * Launch      global = active rounded up by the host, any local
 * Guarantees  every triangle is written once, cell by cell along the rows */
__kernel void emit_cell_triangles(
    __global const VOXEL *restrict voxels, __global const uint *restrict mask,
    __global const uint *restrict active_words,
    __global const uint *restrict row_offsets, __global const uint *restrict cell_vertex_offsets,
    __global const ushort *restrict word_vertices, __global const ushort *restrict word_triangles,
    __global const ushort *restrict word_cell_vertices,
    __global uint *restrict triangles, const uint first_vertex, const uint rows_to_count, const int mirrored,
    const float iso_level, const VALUE outside,
    const int ni, const int nj, const int nk, const int border, const int first_slice, const int first_sample_slice,
    const uint gk, const uint words, const uint row_shift, const uint active)
{
    if (get_global_id(0) >= active)
        return;
    const uint row = active_words[get_global_id(0)] >> row_shift;
    const uint w = active_words[get_global_id(0)] & ((1u << row_shift) - 1);
    const volume_part volume = {voxels, ni, nj, nk, first_slice, border, outside};
    const uint gi = ni + 2 * border, gj = nj + 2 * border;
    const uint j = row % gj, k = row / gj;
    if (j + 1 >= gj || k + 1 >= gk)
        return;
    cell_rows rows;
    load_cell_rows(&rows, mask, j, k, w, gj, words);
    uint rest = find_active_cells(rows, w, gi);
    if (rest == 0)
        return;
    const uint choices = find_choices(&rows, rest);

    const uint first_shift = mirrored ? 8 : 0, last_shift = mirrored ? 0 : 8;
    numbered_rows edges;
    const cell_rows kept = EVERY_EDGE;
    number_rows(&edges, &rows, &kept, mask, row_offsets, word_vertices, first_vertex, j, k, w, gi, gj, gk, words);
    uint cell_vertex = first_vertex + first_cell_vertex(row_offsets, cell_vertex_offsets, row, k, gj)
        + (word_cell_vertices[(size_t)row * words + w] & (HAS_CELL_VERTICES - 1));
    const uint row_triangle = row_offsets[rows_to_count + row] - row_offsets[rows_to_count];
    __global uint *out = triangles + 3 * ((size_t)row_triangle + word_triangles[(size_t)row * words + w]);
    for (; rest != 0; rest &= rest - 1) {
        const uint b = lowest_bit(rest), number = cell_case(rows, b);
        cell_numbers numbers;
        number_cell(&numbers, &edges, b);
        if (choices >> b & 1) {
            const uint found = find_row(number, &volume, (int)(32 * w + b) - border, (int)j - border,
                (int)k + first_sample_slice - border, iso_level);
            out += 3 * write_row(found, numbers, cell_vertex, mirrored, out);
            cell_vertex += row_vertices_of(found);
        } else {
            out += 3 * write_table_cell(number, numbers, first_shift, last_shift, out);
        }
    }
}

/* Write one vertex inside the cell that begins at sample (i, j) of the frame's slice. */
static inline void write_cell_vertex(
    const slice_frame *frame, float i, float j, float3 point, const int8 values, size_t vertex,
    __global float *positions, __global float *normals)
{
    float3 place, slope, up;
#define PLACE(c) place.c = place_cell_vertex(i, j, point, frame->origin.c, frame->origin_rest.c, \
        frame->i_step.c, frame->i_rest.c, frame->j_step.c, frame->j_rest.c, frame->k_step.c)
    PLACE(x);
    PLACE(y);
    PLACE(z);
#undef PLACE
    vstore3(place, vertex, positions);
    field_at(values, point, &slope);
    if (dot3(slope, slope) == 0.0f)
        slope = (float3)(1.0f);
    up = (float3)(dot3(frame->normal_x, slope), dot3(frame->normal_y, slope), dot3(frame->normal_z, slope));
    vstore3(-up / sqrt(dot3(up, up)), vertex, normals);
}

/* Parameters  voxels ... word_cell_vertices   in   as above
 *             slice_frames, steps, margin     in   as in emit_vertices
 *             positions           in/out  (vertices, 3) mm
 *             normals             in/out  (vertices, 3) unit, towards lower values
 * Launch      global = active rounded up by the host, any local
 * Guarantees  every vertex inside a cell is written once; no other is touched */
__kernel void emit_cell_vertices(
    __global const VOXEL *restrict voxels, __global const uint *restrict mask,
    __global const uint *restrict active_words,
    __global const uint *restrict row_offsets, __global const uint *restrict cell_vertex_offsets,
    __global const ushort *restrict word_cell_vertices,
    __global const float4 *restrict slice_frames, __global const float4 *restrict steps, const float4 margin,
    __global float *restrict positions, __global float *restrict normals,
    const float iso_level, const VALUE outside,
    const int ni, const int nj, const int nk, const int border, const int first_slice, const int first_sample_slice,
    const uint gk, const uint words, const uint row_shift, const uint active)
{
    if (get_global_id(0) >= active)
        return;
    const uint row = active_words[get_global_id(0)] >> row_shift;
    const uint w = active_words[get_global_id(0)] & ((1u << row_shift) - 1);
    const volume_part volume = {voxels, ni, nj, nk, first_slice, border, outside};
    const uint gi = ni + 2 * border, gj = nj + 2 * border;
    const uint j = row % gj, k = row / gj;
    if (j + 1 >= gj || k + 1 >= gk)
        return;
    const uint place = word_cell_vertices[(size_t)row * words + w];
    if (!(place & HAS_CELL_VERTICES))
        return;

    slice_frame frame;
    frame.i_step = steps[0].xyz;
    frame.i_rest = steps[1].xyz;
    frame.j_step = steps[2].xyz;
    frame.j_rest = steps[3].xyz;
    frame.margin = margin.xyz;
    load_slice_frame(&frame, slice_frames, k, gk);
    __global const float4 *layer = slice_frames + FRAME_ROWS * (size_t)k + 6;
    frame.normal_x = layer[0].xyz;
    frame.normal_y = layer[1].xyz;
    frame.normal_z = layer[2].xyz;
    cell_rows rows;
    load_cell_rows(&rows, mask, j, k, w, gj, words);
    size_t vertex = first_cell_vertex(row_offsets, cell_vertex_offsets, row, k, gj) + (place & (HAS_CELL_VERTICES - 1));
    for (uint rest = find_choices(&rows, find_active_cells(rows, w, gi)); rest != 0; rest &= rest - 1) {
        const uint b = lowest_bit(rest), number = cell_case(rows, b);
        const int i = (int)(32 * w + b) - border;
        const float8 heights
            = load_heights(&volume, i, (int)j - border, (int)k + first_sample_slice - border, iso_level);
        const uint found = choose_row(number, heights);
        if (row_vertices_of(found) == 0)
            continue;
        const int8 values = sign_values(number, heights);
        float3 lower, upper;
        if (row_vertices_of(found) == 1)
            lower = upper = place_centre(found, values, frame.margin);
        else
            place_waist(values, frame.margin, &lower, &upper);
        const uint diagonal = found >> 24;
        for (uint corner = 0, left = row_vertices_of(found); left != 0; ++corner) {
            if (row_vertices_of(found) > 1 && (corner == diagonal || corner == 7 - diagonal))
                continue;
            const float3 point = (float3)(corner & 1 ? upper.x : lower.x, corner & 2 ? upper.y : lower.y,
                corner & 4 ? upper.z : lower.z);
            write_cell_vertex(&frame, (float)i, (float)((int)j - border), point, values, vertex++, positions, normals);
            --left;
        }
    }
}
