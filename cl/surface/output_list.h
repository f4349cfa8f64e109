/* Where each vertex and each triangle of a surface comes from, for devices whose work-items are lanes (LANES 1).
 *
 * There an item has one vertex or one triangle: if it had a word with all of its own, the lanes beside it would wait
 * for the word that has most.  list_output of cl/surface/cells.cl writes a list of entries by number:
 *
 *      bits   31 .............. 17   16 ........ 12   11 ............... 0
 *             place of the word      sample, or       of a vertex the axis of its edge, of a triangle the edges of its
 *             among those with       cell, of the     three corners, 4 bits each
 *             work, modulo 2^15      word
 *
 * and the whole place of the word of every BLOCK-th entry.  Between two words of a block lie fewer than 2^15 others: a
 * word with work but without vertices (or triangles) has one with them in the next row, and rows have few words. */
#ifndef CLRECON_OUTPUT_LIST_H
#define CLRECON_OUTPUT_LIST_H

#include "include/mask_rows.h"
#include "surface/grown.h"

#define BLOCK 32
#define NO_ENTRY 0xffffffffu
#define PLACE_MASK 0x7fffu

static inline uint make_entry(const uint place, const uint sample, const uint code)
{
    return place << 17 | sample << 12 | code;
}

static inline uint sample_of(const uint entry)
{
    return entry >> 12 & 31;
}

/* Place among the words with work of the word of entry `number`. */
static inline uint find_word(const uint entry, __global const uint *blocks, const uint number)
{
    const uint first = blocks[number / BLOCK];
    return first + ((entry >> 17) - first & PLACE_MASK);
}

/* Note word n, which has the numbers from `begin` to below `end`, for the blocks that begin there. */
static inline void begin_blocks(__global uint *blocks, const uint begin, const uint end, const uint n)
{
    for (uint block = begin / BLOCK + (begin % BLOCK != 0); block * BLOCK < end; ++block)
        blocks[block] = n;
}

/* The bits of a surface, and what is counted of them: parameters of emit_triangles. */
typedef struct {
    __global const uint *mask, *active_words, *row_offsets;
    __global const ushort *word_vertices;
    uint first_vertex;
    uint gi, gj, gk, words, row_shift, active;
    grown_samples grown;
} surface_bits;

/* Number of the vertex on edge `edge` of cell (i, j, k); cell_numbers.h has the edges. */
static inline uint number_edge(const surface_bits *surface, const uint edge, const uint i, const uint j, const uint k)
{
    const uint axis = edge >> 2, first = edge & 1, second = edge >> 1 & 1; /* its place along the other two axes */
    const uint owner = i + (axis != 0 ? first : 0), w = owner >> 5, b = owner & 31;
    const uint owner_j = j + (axis == 0 ? first : axis == 2 ? second : 0), owner_k = k + (axis != 2 ? second : 0);
    const uint row = row_index(owner_j, owner_k, surface->gj), words = surface->words;
    __global const uint *word = surface->mask + (size_t)row * words + w;
    /* as in find_crossed_edges, without windows: samples after the owner do not count */
    const uint own = word[0], has_next = min(surface->gi - 1 - 32 * w, 32u);
    const uint next = w + 1 < words ? word[1] : 0;
    const uint kept = load_grown(&surface->grown, row, w);
    const uint x = (own ^ (own >> 1 | next << 31)) & kept & (uint)low_bits(has_next);
    const uint y = owner_j + 1 < surface->gj ? (own ^ word[words]) & kept : 0;
    const uint z = owner_k + 1 < surface->gk ? (own ^ word[(size_t)words * surface->gj]) & kept : 0;
    const uint before = (1u << b) - 1;
    return surface->first_vertex + surface->row_offsets[row] + surface->word_vertices[(size_t)row * surface->words + w]
        + popcount(x & before) + popcount(y & before) + popcount(z & before)
        + (axis > 0 ? x >> b & 1 : 0) + (axis > 1 ? y >> b & 1 : 0);
}

#endif
