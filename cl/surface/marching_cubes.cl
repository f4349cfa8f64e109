/* Marching cubes on packed bits, with indexed triangles and vertices that neighbouring cells share.
 *
 * References: Lorensen and Cline 1987 (marching cubes); Schroeder, Maynard, Geveci 2015, "Flying Edges" (edges
 * owned by samples, counting before writing); the packing of the inside test to one bit a sample is our own.
 *
 * A cell, with the numbers of its corners in brackets and those of its edges on them:
 *
 *          (6)-------3-------(7)
 *          /|                /|             bits 0, 1, 2 of a corner's number are its x, y, z
 *         6 |               7 |             edges 0 to 3 run along x, 4 to 7 along y, 8 to 11 along z
 *        /  10             /  11            bit b of the cell's case: corner b is inside
 *      (4)-------2-------(5)  |
 *       |   |             |   |
 *       |  (2)-----1------|--(3)            k, z    j, y
 *       8  /              9  /              |      /
 *       | 4               | 5               |    /
 *       |/                |/                |  /
 *      (0)-------0-------(1)                |/______ i, x
 *
 * Sample (i, j, k) is corner 0 of cell (i, j, k), and owns edges 0, 4 and 8.
 *
 * Passes, of which all but the fourth know bits alone: those are in cl/surface/cells.cl, which is built once a device
 *      (one bit a sample, inside or not; per row the words that hold any: cl/masks/classify.cl)
 *   1. count_rows         per row: vertices, triangles and words with work; per word its place in the row
 *      (exclusive scan of all row counts: cl/primitives/scan.cl)
 *   2. total_counts       vertices, triangles and words with work of the slab
 *   3. list_words         the words with work, in order
 *      (on GPUs list_output: the word, the sample and the edges of each vertex and each triangle)
 *   4. emit_vertices      positions and normals of the vertices of each word with work, on GPUs of each vertex
 *   5. emit_triangles     vertex numbers of the triangles of each word with work, on GPUs of each triangle
 *
 * The sample grid is the volume, with one layer of outside around it when the surface is closed.  The passes work on
 * a slab of it: whole slices, with those beyond it that its vertices and their numbers depend on.  A mesh is the same
 * in one slab or in many.
 *
 * A sample owns the edges towards i + 1, j + 1 and k + 1.  Vertices are numbered by row, then by owner along the
 * row, then by axis: the number of any edge's vertex follows from three popcounts, so vertices are computed once
 * and shared without a hash, an atomic or an index array, and the order never depends on the device. */
#include "include/volume.h"
#include "include/mask_rows.h"
#include "surface/grown.h"
#include "surface/vertex_group.h"
#if defined(LABELS)
#include "surface/label_border.h"
#elif defined(MASKS)
#include "surface/mask_border.h"
#else
#include "surface/no_border.h"
#endif

#ifndef WORDS_PER_ITEM
#define WORDS_PER_ITEM 1
#endif

#if LANES == 1
/* A work-item has one vertex, of the word that its entry in the list names: the loops below run once. */
#include "surface/output_list.h"
#define VERTEX_PARAMETERS \
    , __global const uint *restrict vertex_list, __global const uint *restrict vertex_blocks, const uint vertices
#define ITEM_VERTICES { vertex_list, vertex_blocks, vertices }
typedef struct {
    __global const uint *list, *blocks;
    uint count;
} item_vertices;

/* Place among the words with work of the first word of the item; `active` if it has none. */
static inline uint find_first_word(const item_vertices *item, const uint active)
{
    const uint vertex = get_global_id(0);
    if (vertex >= item->count || item->list[vertex] == NO_ENTRY)
        return active;
    return find_word(item->list[vertex], item->blocks, vertex);
}

/* Number of the first vertex of the item; `first_of_word` is that of its first word. */
static inline uint number_first(const item_vertices *item, const uint first_of_word) { return get_global_id(0); }

/* The vertices of the item in a word, one after the other: 4 * sample + axis. */
typedef struct {
    uint vertex, left;
} word_vertex_list;

static inline void list_vertices(
    word_vertex_list *list, const item_vertices *item, const uint x, const uint y, const uint z)
{
    const uint entry = item->list[get_global_id(0)];
    list->vertex = sample_of(entry) << 2 | (entry & 3);
    list->left = 1;
}

static inline uint next_vertex(word_vertex_list *list)
{
    --list->left;
    return list->vertex;
}
#else
#define VERTEX_PARAMETERS
#define ITEM_VERTICES { 0 }
typedef struct {
    int unused;
} item_vertices;

static inline uint find_first_word(const item_vertices *item, const uint active)
{
    return get_global_id(0) * WORDS_PER_ITEM;
}

static inline uint number_first(const item_vertices *item, const uint first_of_word) { return first_of_word; }

typedef struct {
    ushort crossed[96];
    uint at, left;
} word_vertex_list;

static inline void list_vertices(
    word_vertex_list *list, const item_vertices *item, const uint x, const uint y, const uint z)
{
    /* Without branches: whether an axis has its vertex is as good as random, and wrong guesses cost more. */
    uint count = 0;
    for (uint owners = x | y | z; owners != 0; owners &= owners - 1) {
        const uint b = lowest_bit(owners);
        list->crossed[count] = (ushort)(4 * b);
        count += x >> b & 1;
        list->crossed[count] = (ushort)(4 * b + 1);
        count += y >> b & 1;
        list->crossed[count] = (ushort)(4 * b + 2);
        count += z >> b & 1;
    }
    list->at = 0;
    list->left = count;
}

static inline uint next_vertex(word_vertex_list *list)
{
    --list->left;
    return list->crossed[list->at++];
}
#endif

/* Parameters  voxels          in   slices of the volume from first_slice on
 *             mask            in   (gk, gj, words)
 *             active_words    in   (active,)
 *             row_offsets     in   (3, rows_to_count)
 *             word_vertices   in   (gk, gj, words)
 *             slice_frames    in   (gk, 9) float4: position of sample (0, 0, k) in mm (rounded to 12 bits, rest),
 *                                  step to slice k + 1 (w: smallest distance of a vertex from a sample along it, in
 *                                  steps), the three rows of the matrix that maps gradients per index
 *                                  step at the samples of slice k to gradients per mm, and those of the matrix for
 *                                  gradients within the cells up to slice k + 1.  With -D UNEVEN the matrices differ
 *             steps           in   (4,) float4: mm for one step along i (rounded to 12 bits, rest), along j
 *             positions       out  (vertices, 3) mm
 *             normals         out  (vertices, 3) unit, towards lower values; with -D RANGE away from the range
 *             iso_level       where on an edge the surface lies
 *             outside         value beyond the border of a closed volume
 *             value_scale     power of two that takes the values to 1 or below: squares neither over- nor underflow
 *             margin          smallest distance of a vertex from a sample along x, y, in steps: some units in the
 *                             last place of the position, so that no triangle collapses when it is rounded
 *             ni nj nk, border   of the whole volume
 *             first_slice     slice of the volume that `voxels` begins with
 *             first_sample_slice   slice of the sample grid that the mask begins with
 *             gk, words       slices of the mask, and 32-bit words of it in a row
 *             row_shift       a word's number is its row times 2^row_shift, plus its place in the row
 *             active          number of words with work
 *             inside, label   in   with -D LABELS: the label that each sample is inside of, slices as those of `voxels`,
 *                             and the label whose surface it is; see label_border.h
 *             half_way_count  in/out  with -D LABELS: grows by the vertices that HU do not place
 *             upper_level     with -D RANGE: where on an edge from inside to above the range the surface lies
 *             highest         with -D RANGE: the range's highest value
 *             map, label, occupied  in   with -D MASKS: the label map, the label, and the occupancy of all labels, where
 *                             `voxels` is that of the label; slices as those of `voxels`; see mask_border.h
 *             biases          in   (highest label + 1,) with -D MASKS: see mask_border.h
 *             grown           in   (whole_gk, gj, words) with -D GROWN: the samples whose edges have vertices, see growing.cl
 *             first_grown     with -D GROWN: slice of them that the mask begins with
 *             vertex_list, vertex_blocks   in   with LANES 1: of list_output
 *             vertices        with LANES 1: number of vertices in the slab
 * Launch      global = ceil(active / WORDS_PER_ITEM), with LANES 1 vertices; rounded up by the host, any local
 * Guarantees  every position and normal is written once.  Positions are right to one unit in the last place of the
 *             volume's largest coordinate (half a unit up to 4096 samples an axis, where products of a sample number
 *             and a step of 12 bits are exact; sums keep their error) */
__kernel __attribute__((vec_type_hint(floats))) /* else Intel's compiler makes vectors of our vectors: 7 times slower */
void emit_vertices(
    __global const VOXEL *restrict voxels, __global const uint *restrict mask,
    __global const uint *restrict active_words, __global const uint *restrict row_offsets,
    __global const ushort *restrict word_vertices,
    __global const float4 *restrict slice_frames, __global const float4 *restrict steps,
    __global float *restrict positions, __global float *restrict normals,
    const float iso_level, const VALUE outside, const float value_scale, const float4 margin,
    const int ni, const int nj, const int nk, const int border, const int first_slice, const int first_sample_slice,
    const uint gk, const uint words, const uint row_shift, const uint active
    VERTEX_PARAMETERS BORDER_PARAMETERS RANGE_PARAMETERS GROWN_PARAMETERS)
{
    const item_vertices item = ITEM_VERTICES;
    const uint begin = find_first_word(&item, active);
    if (begin >= active)
        return;
    const uint end = min(begin + WORDS_PER_ITEM, active);
    const volume_part volume = {voxels, ni, nj, nk, first_slice, BORDER_GOES_ON ? 0 : border, outside};
    const uint gi = ni + 2 * border, gj = nj + 2 * border;
    const surface_border surface = SURFACE_BORDER;
    const grown_samples grown_here = GROWN_SAMPLES;
    uint half_way = 0;
    slice_frame frame;
    frame.i_step = steps[0].xyz;
    frame.i_rest = steps[1].xyz;
    frame.j_step = steps[2].xyz;
    frame.j_rest = steps[3].xyz;
    frame.margin = margin.xyz;
    frame.iso_level = iso_level;
    frame.value_scale = value_scale;
    set_upper_end(&frame RANGE_ARGUMENTS);

    /* First touches of the volume wait for memory: ask for all that the item will need before it needs any of it. */
    for (uint n = begin; n < end; ++n) {
        const uint row = active_words[n] >> row_shift, w = active_words[n] & ((1u << row_shift) - 1);
        prefetch_around(&volume, (int)(32 * w) - border, (int)(row % gj) - border,
            (int)(row / gj) + first_sample_slice - border);
    }

    vertex_group group;
    uint gathered = 0;
    uint slice_begin = 0, slice_end = 0; /* rows of the slice that `frame` describes */
    uint k = 0;
    size_t written = 0;
    for (uint n = begin; n < end; ++n) {
        const uint row = active_words[n] >> row_shift, w = active_words[n] & ((1u << row_shift) - 1);
        if (row >= slice_end) {
            if (gathered != 0)
                write_vertices(&group, &frame, gathered, positions + 3 * written, normals + 3 * written);
            gathered = 0;
            written = number_first(&item, row_offsets[row] + word_vertices[(size_t)row * words + w]);
            k = row / gj;
            slice_begin = k * gj;
            slice_end = slice_begin + gj;
            load_slice_frame(&frame, slice_frames, k, gk);
        }
        const uint j = row - slice_begin;
        crossed_edges edges;
        find_crossed_edges(&edges, mask, j, k, w, gi, gj, gk, words);
        const uint kept = load_grown(&grown_here, row, w);
        const uint x = (uint)edges.x & kept, y = (uint)edges.y & kept, z = (uint)edges.z & kept;
        word_vertex_list list;
        list_vertices(&list, &item, x, y, z);
        const int vi = (int)(32 * w) - border, vj = (int)j - border, vk = (int)k + first_sample_slice - border;
        const int row_is_inner = vj >= 1 && vj < nj - 2 && vk >= 1 && vk < nk - 2;
        while (list.left != 0) {
            const uint vertex = next_vertex(&list);
            const int i = vi + (int)(vertex >> 2), axis = vertex & 3;
            const int inner = row_is_inner && i >= 1 && i < ni - 2;
            gather_vertex(&group, gathered, &volume, i, vj, vk, axis, inner);
            half_way += gather_border(&group, gathered, &volume, &surface, i, vj, vk, axis, inner);
            ++gathered;
            if (gathered == LANES) {
                write_vertices(&group, &frame, LANES, positions + 3 * written, normals + 3 * written);
                written += LANES;
                gathered = 0;
            }
        }
    }
    if (gathered != 0)
        write_vertices(&group, &frame, gathered, positions + 3 * written, normals + 3 * written);
    count_half_way(&surface, half_way);
}
