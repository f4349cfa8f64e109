/* The samples whose crossed edges have vertices and whose cells have triangles: with -D GROWN those of growing.cl, else
 * all of them. */
#ifndef CLRECON_GROWN_H
#define CLRECON_GROWN_H

#include "surface/cell_numbers.h"

/* Words of the samples of all slices, and the row of them that the mask begins with; row * words is the first word of a
 * row. */
typedef struct {
    __global const uint *bits;
    size_t first_row;
    uint words;
} grown_samples;

/* The parameters of a kernel for the samples, and the samples themselves. */
#ifdef GROWN
#define GROWN_PARAMETERS , __global const uint *restrict grown, const uint first_grown
#define GROWN_SAMPLES { grown, (size_t)first_grown * gj, words }

/* The samples of word w of a row of the mask. */
static inline uint load_grown(const grown_samples *samples, const uint row, const uint w)
{
    return samples->bits[(samples->first_row + row) * samples->words + w];
}

/* Those of the four rows around row (j, k) of cells. */
static inline void load_grown_rows(
    cell_rows *kept, const grown_samples *samples, const uint j, const uint k, const uint w, const uint gj)
{
    load_cell_rows(kept, samples->bits + samples->first_row * samples->words, j, k, w, gj, samples->words);
}
#else
#define GROWN_PARAMETERS
#define GROWN_SAMPLES { 0, 0, 0 }
static inline uint load_grown(const grown_samples *samples, const uint row, const uint w) { return ~0u; }

static inline void load_grown_rows(
    cell_rows *kept, const grown_samples *samples, const uint j, const uint k, const uint w, const uint gj)
{
    const cell_rows every_edge = EVERY_EDGE;
    *kept = every_edge;
}
#endif

#endif
