/* Marching cubes: the passes that know bits alone, and no voxels.  cl/surface/marching_cubes.cl has the cell, all
 * passes and their order, and the one that reads voxels.
 *
 * Apart from it because a driver builds every kernel of a file for each type of voxels, uneven slices, ranges and
 * labels: these are the same for all.
 *
 * References: as in cl/surface/marching_cubes.cl. */
#include "include/mask_rows.h"
#include "surface/cell_numbers.h"
#include "surface/grown.h"
#include "surface/mc_tables.h"
#include "surface/output_list.h"

#ifndef LANES
#define LANES 1
#endif
#ifndef WORDS_PER_ITEM
#define WORDS_PER_ITEM 1
#endif

/* Words of a row that may own a vertex or have an active cell: from .x to below .y, which is 0 where there are none. */
#ifdef GROWN
#define EXTENT_PARAMETERS , __global const ushort2 *restrict grown_extents
#define EXTENTS grown_extents
static inline uint2 find_words(
    __global const ushort2 *extents, const grown_samples *grown, const uint row, const uint gj, const int has_y,
    const int has_z)
{
    return convert_uint2(extents[grown->first_row + row]);
}
#else
#define EXTENT_PARAMETERS
#define EXTENTS row_extents
/* Beyond the extents of the four rows everything is outside; the sample before may own an edge into them. */
static inline uint2 find_words(
    __global const ushort2 *extents, const grown_samples *grown, const uint row, const uint gj, const int has_y,
    const int has_z)
{
    const ushort2 around[4] = {extents[row], extents[has_y ? row + 1 : row], extents[has_z ? row + gj : row],
        extents[has_y && has_z ? row + gj + 1 : row]};
    uint begin = 0xffff, end = 0;
    for (uint n = 0; n < 4; ++n) {
        if (around[n].x < around[n].y) {
            begin = min(begin, (uint)around[n].x);
            end = max(end, (uint)around[n].y);
        }
    }
    return (uint2)(begin, end);
}
#endif

/* Parameters  mask             in   (gk, gj, words)
 *             row_extents      in   (gk, gj)
 *             row_counts       out  (3, rows_to_count) vertices owned by each row, triangles of its cells, words with
 *                                   work: words that own a vertex or have an active cell
 *             words_with_work  out  (rows_to_count, flag_words) bit w of a row: word w has work
 *             word_vertices    out  (rows_to_count, words) vertices of the row before each word
 *             word_triangles   out  (rows_to_count, words) triangles of the row before each word
 *             gi gj gk         samples; words a row; flag_words = ceil(words / 32), rounded up to a power of two
 *             rows_to_count    rows that are counted, the first ones of the mask
 *             grown            in   (whole_gk, gj, words) with -D GROWN: the grown samples of growing.cl; other edges and
 *                                   cells do not count
 *             grown_extents    in   (whole_gk, gj) with -D GROWN: their extents, in the place of row_extents
 *             first_grown      with -D GROWN: slice of them that the mask begins with
 * Launch      global = rows_to_count rounded up by the host, any local
 * Assumes     5 (gi + 1) < 65536, so that places in a row fit 16 bits
 * Guarantees  every output is written, but for the places of words beyond the extents, which nothing asks for */
__kernel void count_rows(
    __global const uint *restrict mask, __global const ushort2 *restrict row_extents,
    __global uint *restrict row_counts, __global uint *restrict words_with_work,
    __global ushort *restrict word_vertices, __global ushort *restrict word_triangles,
    const uint gi, const uint gj, const uint gk, const uint words, const uint flag_words, const uint rows_to_count
    GROWN_PARAMETERS EXTENT_PARAMETERS)
{
    const uint row = get_global_id(0);
    if (row >= rows_to_count)
        return;
    const uint j = row % gj;
    const uint k = row / gj;
    const int has_y = j + 1 < gj, has_z = k + 1 < gk;
    /* Rows (y, z) around the row of cells; where the grid ends, rows beyond are the last one: no edge is crossed. */
    __global const uint *y0z0 = mask + (size_t)row * words;
    __global const uint *y1z0 = has_y ? y0z0 + words : y0z0;
    __global const uint *y0z1 = has_z ? y0z0 + (size_t)gj * words : y0z0;
    __global const uint *y1z1 = has_y && has_z ? y0z1 + words : y0z0;
    const grown_samples grown_here = GROWN_SAMPLES;
    const uint2 row_words = find_words(EXTENTS, &grown_here, row, gj, has_y, has_z);
    const uint begin = row_words.x - (row_words.x != 0), end = row_words.y;
    for (uint f = 0; f < flag_words; ++f)
        words_with_work[(size_t)row * flag_words + f] = 0;
    if (end == 0) {
        row_counts[row] = row_counts[rows_to_count + row] = row_counts[2 * (size_t)rows_to_count + row] = 0;
        return;
    }
    cell_rows rows = {y0z0[begin], y1z0[begin], y0z1[begin], y1z1[begin]};
    uint vertices = 0, triangles = 0, working = 0, flags = 0;
    for (uint w = begin; w < end; ++w) {
        word_vertices[(size_t)row * words + w] = (ushort)vertices;
        word_triangles[(size_t)row * words + w] = (ushort)triangles;
        const uint next = w + 1 < words ? w + 1 : w;
        const cell_rows next_rows = {y0z0[next], y1z0[next], y0z1[next], y1z1[next]};
        rows.y0z0 |= next_rows.y0z0 << 32;
        rows.y1z0 |= next_rows.y1z0 << 32;
        rows.y0z1 |= next_rows.y0z1 << 32;
        rows.y1z1 |= next_rows.y1z1 << 32;
        const uint kept = load_grown(&grown_here, row, w);
        const uint active = find_active_cells(rows, w, gi) & kept;
        const uint y = (uint)(rows.y0z0 ^ rows.y1z0) & kept, z = (uint)(rows.y0z0 ^ rows.y0z1) & kept;
        if ((active | y | z) != 0) {
            const uint x = (uint)((rows.y0z0 ^ rows.y0z0 >> 1) & samples_with_next(w, gi)) & kept;
            vertices += popcount(x) + popcount(y) + popcount(z);
            if (has_y && has_z) {
                for (uint rest = active; rest != 0; rest &= rest - 1)
                    triangles += (uint)MC_TRIANGLES[cell_case(rows, lowest_bit(rest))] & 15;
            }
            flags |= 1u << (w & 31);
            ++working;
        }
        if ((w & 31) == 31 || w + 1 == end) {
            words_with_work[(size_t)row * flag_words + (w >> 5)] = flags;
            flags = 0;
        }
        rows = next_rows;
    }
    row_counts[row] = vertices;
    row_counts[rows_to_count + row] = triangles;
    row_counts[2 * (size_t)rows_to_count + row] = working;
}

/* Parameters  row_offsets  in   (3, rows_to_count) sum of all row counts before each
 *             total        in   (1,) sum of all row counts
 *             totals       out  (3,) vertices, triangles and words with work of the first `rows` rows
 * Launch      one item
 * Assumes     the sum of all row counts fits 32 bits */
__kernel void total_counts(
    __global const uint *restrict row_offsets, __global const ulong *restrict total, __global uint *restrict totals,
    const uint rows, const uint rows_to_count)
{
    if (get_global_id(0) != 0)
        return;
    for (uint which = 0; which < 3; ++which) {
        const size_t begin = (size_t)which * rows_to_count, end = begin + rows;
        totals[which] = (end == 3 * (size_t)rows_to_count ? (uint)total[0] : row_offsets[end]) - row_offsets[begin];
    }
}

/* Parameters  words_with_work  in   (rows_to_count, flag_words)
 *             row_offsets      in   (3, rows_to_count)
 *             active_words     out  (active,) numbers of the words with work, ascending: row times 2^row_shift, plus
 *                                   the place in the row
 *             rows             rows whose words are listed
 * Launch      global = rows rounded up by the host, any local
 * Guarantees  every number is written once */
__kernel void list_words(
    __global const uint *restrict words_with_work, __global const uint *restrict row_offsets,
    __global uint *restrict active_words,
    const uint rows, const uint rows_to_count, const uint flag_words, const uint row_shift)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    __global const uint *word_offsets = row_offsets + 2 * (size_t)rows_to_count;
    uint place = word_offsets[row] - word_offsets[0];
    for (uint f = 0; f < flag_words; ++f) {
        for (uint flags = words_with_work[(size_t)row * flag_words + f]; flags != 0; flags &= flags - 1)
            active_words[place++] = (row << row_shift) + 32 * f + lowest_bit(flags);
    }
}

#if LANES == 1
/* Parameters  mask              in   (gk, gj, words)
 *             active_words      in   (active,)
 *             row_offsets       in   (3, rows_to_count)
 *             word_vertices     in   (gk, gj, words)
 *             word_triangles    in   (gk, gj, words)
 *             vertex_list       out  (vertices,) and
 *             triangle_list     out  (triangles,) entries, see output_list.h
 *             vertex_blocks     out  (ceil(vertices / BLOCK),) and
 *             triangle_blocks   out  (ceil(triangles / BLOCK),) place among the words with work of the word that has the
 *                                    first number of each block
 *             vertices, triangles   of the slab; no triangles are listed where trilinear.cl writes them
 *             the others as for emit_triangles
 * Launch      global = active rounded up by the host, any local; on GPUs alone
 * Guarantees  every entry is written once; numbers of vertices inside cells, which are no word's, have NO_ENTRY */
__kernel void list_output(
    __global const uint *restrict mask, __global const uint *restrict active_words,
    __global const uint *restrict row_offsets, __global const ushort *restrict word_vertices,
    __global const ushort *restrict word_triangles,
    __global uint *restrict vertex_list, __global uint *restrict vertex_blocks,
    __global uint *restrict triangle_list, __global uint *restrict triangle_blocks,
    const uint vertices, const uint triangles, const uint rows_to_count,
    const uint gi, const uint gj, const uint gk, const uint words, const uint row_shift, const uint active
    GROWN_PARAMETERS)
{
    const uint n = get_global_id(0);
    if (n >= active)
        return;
    const uint row = active_words[n] >> row_shift, w = active_words[n] & ((1u << row_shift) - 1);
    const uint k = row / gj, j = row - k * gj;
    const size_t at = (size_t)row * words + w;
    /* The word after it, where its numbers end. */
    const int is_last = n + 1 == active;
    const uint next = active_words[is_last ? n : n + 1];
    const uint next_row = next >> row_shift;
    const size_t next_at = (size_t)next_row * words + (next & ((1u << row_shift) - 1));
    const grown_samples grown_here = GROWN_SAMPLES;
    const uint kept = load_grown(&grown_here, row, w);

    uint vertex = row_offsets[row] + word_vertices[at];
    const uint vertices_end = is_last ? vertices : row_offsets[next_row] + word_vertices[next_at];
    begin_blocks(vertex_blocks, vertex, vertices_end, n);
    crossed_edges edges;
    find_crossed_edges(&edges, mask, j, k, w, gi, gj, gk, words);
    const uint x = (uint)edges.x & kept, y = (uint)edges.y & kept, z = (uint)edges.z & kept;
    uint axes = 0, sample = 0, owners = x | y | z;
    for (uint left = popcount(x) + popcount(y) + popcount(z); left != 0; --left, axes &= axes - 1) {
        if (axes == 0) {
            sample = lowest_bit(owners);
            axes = (x >> sample & 1) | (y >> sample & 1) << 1 | (z >> sample & 1) << 2;
            owners &= owners - 1;
        }
        vertex_list[vertex++] = make_entry(n, sample, lowest_bit(axes));
    }
    while (vertex < vertices_end)
        vertex_list[vertex++] = NO_ENTRY;

    if (triangles == 0)
        return;
    __global const uint *triangle_offsets = row_offsets + rows_to_count;
    const uint first = triangle_offsets[0];
    uint triangle = triangle_offsets[row] - first + word_triangles[at];
    const uint triangles_end = is_last ? triangles : triangle_offsets[next_row] - first + word_triangles[next_at];
    begin_blocks(triangle_blocks, triangle, triangles_end, n);
    if (j + 1 >= gj || k + 1 >= gk)
        return;
    cell_rows rows;
    load_cell_rows(&rows, mask, j, k, w, gj, words);
    ulong corners = 0; /* of the triangles of cell `sample` that are still to come */
    uint rest = find_active_cells(rows, w, gi) & kept;
    for (uint left = 0; triangle < triangles_end; --left, corners >>= 12) {
        if (left == 0) {
            sample = lowest_bit(rest);
            rest &= rest - 1;
            corners = MC_TRIANGLES[cell_case(rows, sample)];
            left = (uint)corners & 15;
            corners >>= 4;
        }
        triangle_list[triangle++] = make_entry(n, sample, (uint)corners & 0xfff);
    }
}

/* Write the triangle of a work-item; the shifts say where in an entry its first and its last corner stand. */
#define TRIANGLE_PARAMETERS \
    , __global const uint *restrict triangle_list, __global const uint *restrict triangle_blocks, const uint triangle_count
#define EMIT_TRIANGLES(surface, first_shift, last_shift) \
    emit_listed_triangle(surface, triangle_list, triangle_blocks, triangle_count, first_shift, last_shift, triangles)

static inline void emit_listed_triangle(
    const surface_bits *surface, __global const uint *triangle_list, __global const uint *triangle_blocks,
    const uint triangle_count, const uint first_shift, const uint last_shift, __global uint *triangles)
{
    const uint triangle = get_global_id(0);
    if (triangle >= triangle_count)
        return;
    const uint entry = triangle_list[triangle];
    const uint word = surface->active_words[find_word(entry, triangle_blocks, triangle)];
    const uint row = word >> surface->row_shift, w = word & ((1u << surface->row_shift) - 1);
    const uint k = row / surface->gj, j = row - k * surface->gj, i = 32 * w + sample_of(entry);
    vstore3((uint3)(number_edge(surface, entry >> first_shift & 15, i, j, k),
        number_edge(surface, entry >> 4 & 15, i, j, k),
        number_edge(surface, entry >> last_shift & 15, i, j, k)), triangle, triangles);
}
#else
#define TRIANGLE_PARAMETERS , __global const ushort *restrict word_triangles
#define EMIT_TRIANGLES(surface, first_shift, last_shift) \
    emit_words(surface, row_offsets + rows_to_count, word_triangles, first_shift, last_shift, triangles)

/* Write the triangles of a cell from number *triangle on; `packed` is its row of MC_TRIANGLES, and the shifts say where
 * in a packed triangle its first and its last corner stand.  *waits triangles wait in private memory for their turn, and
 * the last ones for flush_triangles. */
#define TRIANGLES_WAITING 64

static inline void flush_triangles(const uint *waiting, uint count, __global uint *out)
{
    uint n = 0;
    for (; n + 8 <= 3 * count; n += 8)
        vstore8(vload8(0, waiting + n), 0, out + n);
    for (; n < 3 * count; ++n)
        out[n] = waiting[n];
}

static inline void write_triangles(
    const cell_numbers *edge_numbers, const ulong packed, const uint first_shift, const uint last_shift,
    uint *waiting, uint *waits, size_t *triangle, __global uint *triangles)
{
    /* Two triangles whether they count or not, the rest where there are more: wrong guesses cost more. */
    __private uint *out = waiting + 3 * *waits;
    const uint count = (uint)packed & 15;
    uint numbers[16];
    vstore8(edge_numbers->along_xy, 0, numbers);
    vstore4(edge_numbers->along_z, 2, numbers);
#define PUT(n) \
    out[3 * n] = numbers[packed >> (4 + 12 * n + first_shift) & 15]; \
    out[3 * n + 1] = numbers[packed >> (8 + 12 * n) & 15]; \
    out[3 * n + 2] = numbers[packed >> (4 + 12 * n + last_shift) & 15];
    PUT(0) PUT(1)
    if (count > 2) {
        PUT(2) PUT(3) PUT(4)
    }
#undef PUT
    *waits += count;
    if (*waits > TRIANGLES_WAITING - 5) {
        flush_triangles(waiting, *waits, triangles + 3 * *triangle);
        *triangle += *waits;
        *waits = 0;
    }
}

/* Write the triangles of the words of a work-item, cell by cell. */
static inline void emit_words(
    const surface_bits *surface, __global const uint *triangle_offsets, __global const ushort *word_triangles,
    const uint first_shift, const uint last_shift, __global uint *triangles)
{
    const uint gi = surface->gi, gj = surface->gj, gk = surface->gk, words = surface->words;
    const uint row_shift = surface->row_shift;
    __global const uint *active_words = surface->active_words;
    const uint begin = get_global_id(0) * WORDS_PER_ITEM;
    if (begin >= surface->active)
        return;
    const uint end = min(begin + WORDS_PER_ITEM, surface->active);
    uint waiting[3 * TRIANGLES_WAITING];
    uint waits = 0;
    const uint first_row = active_words[begin] >> row_shift;
    size_t triangle = (size_t)(triangle_offsets[first_row] - triangle_offsets[0])
        + word_triangles[(size_t)first_row * words + (active_words[begin] & ((1u << row_shift) - 1))];
    uint slice_begin = 0, slice_end = 0, k = 0;
    for (uint n = begin; n < end; ++n) {
        const uint row = active_words[n] >> row_shift, w = active_words[n] & ((1u << row_shift) - 1);
        if (row >= slice_end) {
            k = row / gj;
            slice_begin = k * gj;
            slice_end = slice_begin + gj;
        }
        const uint j = row - slice_begin;
        if (j + 1 >= gj || k + 1 >= gk)
            continue;
        cell_rows rows, kept;
        load_cell_rows(&rows, surface->mask, j, k, w, gj, words);
        load_grown_rows(&kept, &surface->grown, j, k, w, gj);
        uint rest = find_active_cells(rows, w, gi) & (uint)kept.y0z0;
        numbered_rows edges;
        number_rows(&edges, &rows, &kept, surface->mask, surface->row_offsets, surface->word_vertices,
            surface->first_vertex, j, k, w, gi, gj, gk, words);
        for (; rest != 0; rest &= rest - 1) {
            const uint b = lowest_bit(rest);
            cell_numbers edge_numbers;
            number_cell(&edge_numbers, &edges, b);
            write_triangles(
                &edge_numbers, MC_TRIANGLES[cell_case(rows, b)], first_shift, last_shift, waiting, &waits, &triangle,
                triangles);
        }
    }
    flush_triangles(waiting, waits, triangles + 3 * triangle);
}
#endif

/* Parameters  mask              in   (gk, gj, words)
 *             active_words      in   (active,)
 *             row_offsets       in   (3, rows_to_count)
 *             word_vertices     in   (gk, gj, words)
 *             triangles         out  (triangles, 3) vertex numbers, counter-clockwise as seen from lower values
 *             first_vertex      number of the slab's first vertex
 *             rows_to_count     rows that were counted
 *             gi gj gk, words   as above
 *             row_shift, active   as in cl/surface/marching_cubes.cl
 *             word_triangles    in   (gk, gj, words); with LANES 1 in its place
 *             triangle_list, triangle_blocks   in   of list_output
 *             triangle_count    of the slab
 *             grown, first_grown   with -D GROWN: as for count_rows
 *             mirrored          1 when index space is left-handed in mm: the winding is turned round
 * Launch      global = ceil(active / WORDS_PER_ITEM), with LANES 1 triangle_count; rounded up by the host, any local
 * Guarantees  every triangle is written once, cell by cell along the rows */
__kernel void emit_triangles(
    __global const uint *restrict mask, __global const uint *restrict active_words,
    __global const uint *restrict row_offsets, __global const ushort *restrict word_vertices,
    __global uint *restrict triangles, const uint first_vertex, const uint rows_to_count,
    const uint gi, const uint gj, const uint gk, const uint words, const uint row_shift, const uint active,
    const int mirrored TRIANGLE_PARAMETERS GROWN_PARAMETERS)
{
    const uint first_shift = mirrored ? 8 : 0, last_shift = mirrored ? 0 : 8;
    const surface_bits surface = {
        mask, active_words, row_offsets, word_vertices, first_vertex, gi, gj, gk, words, row_shift, active, GROWN_SAMPLES};
    EMIT_TRIANGLES(&surface, first_shift, last_shift);
}
