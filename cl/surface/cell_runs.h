/* Runs of active cells: their faces, their joining, and the words of a mask without a border on the sample grid. */
#ifndef CLRECON_CELL_RUNS_H
#define CLRECON_CELL_RUNS_H

#include "include/mask_rows.h"

/* The corners at i of a row of cells: bit b of `any` where one of the four samples is inside, of `all` where all are. */
typedef struct {
    ulong any, all;
} corner_columns;

static inline corner_columns join_rows(cell_rows rows)
{
    return (corner_columns){rows.y0z0 | rows.y1z0 | rows.y0z1 | rows.y1z1,
        rows.y0z0 & rows.y1z0 & rows.y0z1 & rows.y1z1};
}

/* Faces of the cells of a word towards the rows `a` and `b` of samples, that are mixed. */
static inline uint find_mixed_faces(ulong a, ulong b, uint w, uint gi)
{
    const ulong any = a | b, all = a & b;
    return (uint)((any | any >> 1) & ~(all & all >> 1) & samples_with_next(w, gi));
}

/* The parent of a run, while others may write it.  A load of an aligned word is whole on every device; a checker of races
 * does not know that, and is given an atomic operation that changes nothing (-D ATOMIC_LOADS). */
static inline uint load_parent(volatile __global uint *parents, uint run)
{
#ifdef ATOMIC_LOADS
    return atomic_or(parents + run, 0u);
#else
    return parents[run];
#endif
}

/* The run without a parent that run `run` leads to, when nothing is written any more. */
static inline uint find_root(volatile __global const uint *parents, uint run)
{
    uint parent = parents[run];
    while (parent != run) {
        run = parent;
        parent = parents[run];
    }
    return run;
}

/* The same, and halves the way: every run passed gets its parent's parent, which never becomes larger by it. */
static inline uint halve_way(volatile __global uint *parents, uint run)
{
    uint parent = load_parent(parents, run);
    while (parent != run) {
        const uint next = load_parent(parents, parent);
        if (next != parent)
            atomic_min(parents + run, next);
        run = next;
        parent = load_parent(parents, run);
    }
    return run;
}

/* Join the components of two runs: the larger root gets the smaller one as its parent. */
static inline void unite(volatile __global uint *parents, uint a, uint b)
{
    a = halve_way(parents, a);
    b = halve_way(parents, b);
    while (a != b) {
        const uint large = max(a, b), small = min(a, b);
        const uint parent = atomic_cmpxchg(parents + large, large, small);
        if (parent == large)
            return;
        a = halve_way(parents, parent); /* it was no root any more */
        b = small;
    }
}

/* Word w of row (j, k) of the sample grid, of a mask of the volume without its border. */
static inline uint load_seeds(
    __global const uint *seeds, uint j, uint k, uint w, uint gj, uint gk, uint border, uint voxel_words)
{
    if (border != 0 && (j == 0 || j + 1 == gj || k == 0 || k + 1 == gk))
        return 0;
    const size_t row = ((size_t)(k - border) * (gj - 2 * border) + (j - border)) * voxel_words;
    const uint own = w < voxel_words ? seeds[row + w] : 0;
    return border == 0 ? own : own << 1 | (w > 0 ? seeds[row + w - 1] >> 31 : 0);
}

#endif
