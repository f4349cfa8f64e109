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

/* Give a run that is no root an ancestor as its parent.  Another item may do so at the same time, whichever is last: both
 * are ancestors, and a run that is no root never becomes one again. */
static inline void shorten_way(volatile __global uint *parents, uint run, uint ancestor)
{
#ifdef ATOMIC_LOADS
    atomic_min(parents + run, ancestor);
#else
    parents[run] = ancestor;
#endif
}

/* The same, and halves the way: every run passed gets its parent's parent. */
static inline uint halve_way(volatile __global uint *parents, uint run)
{
    uint parent = load_parent(parents, run);
    while (parent != run) {
        const uint next = load_parent(parents, parent);
        if (next != parent)
            shorten_way(parents, run, next);
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

/* Join the runs of a row of cells with those of the next one, row `other`, in word w.  `mixed` are the
 * faces, `joined` those whose cells others join; `mixed_before` says whether the last face of the word before is mixed,
 * and is then told that of this word.  Part of the kernel by order: compilers for CPUs would make a call of it. */
static inline __attribute__((always_inline)) void join_word(
    volatile __global uint *parents, __global const uint *run_starts, __global const ushort *word_runs,
    __global const uint *row_offsets, uint row, uint other, uint w, uint words, uint mixed, uint joined,
    uint *mixed_before)
{
    if (mixed == 0) {
        *mixed_before = 0;
        return;
    }
    const size_t at = (size_t)row * words + w, other_at = (size_t)other * words + w;
    const uint starts = run_starts[at], other_starts = run_starts[other_at];
    /* Where both runs go on from a cell whose face is mixed too, they have been joined there. */
    uint joins = mixed & ~joined & ~((mixed << 1 | *mixed_before) & ~starts & ~other_starts);
    *mixed_before = mixed >> 31;
    for (; joins != 0; joins &= joins - 1) {
        const uint upto = (joins & -joins) | ((joins & -joins) - 1);
        unite(parents, row_offsets[row] + word_runs[at] + popcount(starts & upto) - 1,
            row_offsets[other] + word_runs[other_at] + popcount(other_starts & upto) - 1);
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
