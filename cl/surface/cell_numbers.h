/* Vertex numbers of the edges of the cells of a word.
 *
 * A cell's 12 edges are owned by the samples of four rows (y, z) around its row of cells: the number of an edge is
 * that of the first vertex of its owner's word, plus the vertices that the owners before it have, plus the owner's own
 * before the edge.
 *
 *      y0z1 ---- y1z1      The four rows, seen along i: y0z0 is row (j, k) of samples, y1z0 row (j + 1, k),
 *       |          |       y0z1 row (j, k + 1) and y1z1 row (j + 1, k + 1).
 *      y0z0 ---- y1z0
 *
 *      owner, bit b of the word       0          1        2          3        4
 *      its crossed edges              x          -        x, z       y        x, y, z
 *      their vertices, from `first`   +0                  +1, +2     +3       +4, +5, +6 */
#ifndef CLRECON_CELL_NUMBERS_H
#define CLRECON_CELL_NUMBERS_H

#include "include/mask_rows.h"
#include "surface/picks.h"

/* The crossed edges owned by one row of samples, and their numbers. */
typedef struct {
    ulong xy; /* low 32 bits: along x, high: along y */
    uint z;
    ulong x_window, y_window; /* samples 0..32 of the word */
    uint first; /* number of the first vertex of the word */
} numbered_edges;

static inline void number_edges(
    numbered_edges *edges, ulong own, ulong next_y, ulong next_z, ulong with_next, ulong kept, uint first)
{
    edges->x_window = (own ^ own >> 1) & with_next & kept;
    edges->y_window = (own ^ next_y) & kept;
    edges->xy = (edges->x_window & 0xffffffffUL) | edges->y_window << 32;
    edges->z = (uint)((own ^ next_z) & kept);
    edges->first = first;
}

/* Number of the first vertex of the owners from sample b on. */
static inline uint number_at(const numbered_edges *edges, uint b)
{
    const uint before = (1u << b) - 1;
    return edges->first + (uint)popcount(edges->xy & (before | (ulong)before << 32)) + popcount(edges->z & before);
}

/* The four rows around a row of cells. */
typedef struct {
    numbered_edges y0z0, y1z0, y0z1, y1z1;
} numbered_rows;

/* For number_rows: all crossed edges have a vertex. */
#define EVERY_EDGE {~(ulong)0, ~(ulong)0, ~(ulong)0, ~(ulong)0}

/* Number the edges of word w of the four rows around row (j, k) of cells.  `kept` are the samples of the four rows whose
 * crossed edges have a vertex.  `row_offsets` and `word_vertices` say how
 * many vertices come before each row and, in it, before each word; `first_vertex` is the number of the very first. */
static inline void number_rows(
    numbered_rows *edges, const cell_rows *rows, const cell_rows *kept, __global const uint *mask,
    __global const uint *row_offsets,
    __global const ushort *word_vertices, uint first_vertex, uint j, uint k, uint w,
    uint gi, uint gj, uint gk, uint words)
{
    /* The rows beyond, from which the row of cells has the edges of its far side. */
    const uint row = row_index(j, k, gj);
    const ulong y2z0 = j + 2 < gj ? load_window(mask, row + 2, w, words) : rows->y1z0;
    const ulong y2z1 = j + 2 < gj ? load_window(mask, row + gj + 2, w, words) : rows->y1z1;
    const ulong y0z2 = k + 2 < gk ? load_window(mask, row + 2 * gj, w, words) : rows->y0z1;
    const ulong y1z2 = k + 2 < gk ? load_window(mask, row + 2 * gj + 1, w, words) : rows->y1z1;
    const ulong with_next = samples_with_next(w, gi);
#define FIRST(r) (first_vertex + row_offsets[r] + word_vertices[(size_t)(r) * words + w])
    number_edges(&edges->y0z0, rows->y0z0, rows->y1z0, rows->y0z1, with_next, kept->y0z0, FIRST(row));
    number_edges(&edges->y1z0, rows->y1z0, y2z0, rows->y1z1, with_next, kept->y1z0, FIRST(row + 1));
    number_edges(&edges->y0z1, rows->y0z1, rows->y1z1, y0z2, with_next, kept->y0z1, FIRST(row + gj));
    number_edges(&edges->y1z1, rows->y1z1, y2z1, y1z2, with_next, kept->y1z1, FIRST(row + gj + 1));
#undef FIRST
}

/* Vertex numbers of the 12 edges of a cell. */
typedef struct {
    uint8 along_xy;
    uint4 along_z;
} cell_numbers;

static inline uint pick_number(const cell_numbers numbers, uint edge)
{
    return (uint)(edge & 8 ? pick_4(as_int4(numbers.along_z), edge) : pick_8(as_int8(numbers.along_xy), edge));
}

/* Vertex numbers of the 12 edges of cell b of the word; those of edges that are not crossed mean nothing. */
static inline void number_cell(cell_numbers *numbers, const numbered_rows *edges, uint b)
{
#define BIT(window, at) ((uint)((window) >> (at)) & 1)
    const uint at0 = number_at(&edges->y0z0, b), at1 = number_at(&edges->y1z0, b), at2 = number_at(&edges->y0z1, b);
    const uint x0 = BIT(edges->y0z0.x_window, b), x1 = BIT(edges->y1z0.x_window, b), x2 = BIT(edges->y0z1.x_window, b);
    const uint y0 = BIT(edges->y0z0.y_window, b), y1 = BIT(edges->y1z0.y_window, b), y2 = BIT(edges->y0z1.y_window, b);
    const uint after0 = at0 + x0 + y0 + (edges->y0z0.z >> b & 1) + BIT(edges->y0z0.x_window, b + 1);
    const uint after1 = at1 + x1 + y1 + (edges->y1z0.z >> b & 1) + BIT(edges->y1z0.x_window, b + 1);
    const uint after2 = at2 + x2 + y2 + (edges->y0z1.z >> b & 1) + BIT(edges->y0z1.x_window, b + 1);
    numbers->along_xy
        = (uint8)(at0, at1, at2, number_at(&edges->y1z1, b), at0 + x0, after0, at2 + x2, after2);
    numbers->along_z = (uint4)(at0 + x0 + y0, after0 + BIT(edges->y0z0.y_window, b + 1), at1 + x1 + y1,
        after1 + BIT(edges->y1z0.y_window, b + 1));
#undef BIT
}

#endif
