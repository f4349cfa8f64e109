/* The trilinear field of a volume: values and gradients for LANES places at once.
 *
 * The volume extends half a voxel beyond the outermost voxel centres; there the nearest centre's value holds. */
#ifndef CLRECON_FIELD_H
#define CLRECON_FIELD_H

#include "include/lanes.h"
#include "include/volume.h"
#include "rays/window.h"

/* -D LEAST_VALUE: voxels with lower values count as if they had this one, before anything is interpolated. */
#ifdef LEAST_VALUE
/* Not greater(): Mesa 22.3 makes wrong code of `value > least ? value : least` with 16-bit voxels. */
#define HOLD_FLOATS(values) choose((values) < (floats)(LEAST_VALUE), (floats)(LEAST_VALUE), values)
#define HOLD_PAIRS(pairs) hold_pairs(pairs)
#else
#define HOLD_FLOATS(values) (values)
#define HOLD_PAIRS(pairs) (pairs)
#endif

/* A volume, or the slices of it from first_k to end_k - 1 that a device holds: at least two along each axis. */
typedef struct {
    __global const VOXEL *voxels;
    int ni, nj; /* of the buffer */
    int first_k, end_k;
    float4 last; /* indices of the last voxel centres of the whole volume, along i, j, k */
} field;

/* Values at offset `at` from `corner` and one further along i.  Two 16-bit voxels come with one load.  That it is
 * volatile keeps compilers from making a gather instruction of them, which takes longer. */
#if LANES == 8 && VOXEL_IS_SHORT
typedef int pair_of_shorts __attribute__((aligned(2)));
#define PAIR(corner, at) (*(volatile __global const pair_of_shorts *)((corner) + (at)))
#define LOAD_PAIRS(corner, at, low, high) \
    { \
        const ints pairs = (ints)(PAIR(corner, (at).s0), PAIR(corner, (at).s1), PAIR(corner, (at).s2), \
            PAIR(corner, (at).s3), PAIR(corner, (at).s4), PAIR(corner, (at).s5), PAIR(corner, (at).s6), \
            PAIR(corner, (at).s7)); \
        low = to_floats((pairs << 16) >> 16); \
        high = to_floats(pairs >> 16); \
    }
#else
#define LOAD_PAIRS(corner, at, low, high) \
    { \
        low = (floats)(GATHER(VOXEL, corner, at)); \
        high = (floats)(GATHER(VOXEL, corner + 1, at)); \
    }
#endif

/* Whether LANES places lie beside no voxel: rays run through the box of slices that lie over each other. */
#ifdef UNEVEN
static inline ints lie_in_slice(const field *f, const floats i, const floats j)
{
    return (i >= -0.5f) & (i <= f->last.x + 0.5f) & (j >= -0.5f) & (j <= f->last.y + 0.5f);
}
#else
static inline ints lie_in_slice(const field *f, const floats i, const floats j) { return (ints)(-1); }
#endif

/* Cells that LANES places near each other lie in, and their parts of the way through them. */
typedef struct {
    ints i, j, k;
    floats part_i, part_j, part_k;
    __global const VOXEL *row; /* what a window shows of the row that they begin in, and where in it each does */
    ints at;
} cell_lanes;

/* Differences per index step at LANES places, interpolated within the slices below and above each: central differences
 * of voxels, half a one-sided difference at the border. */
typedef struct {
    floats below_i, below_j, below_k, above_i, above_j, above_k;
    floats share; /* of the slice above */
} slopes;

/* With `inner` all places lie within the second voxels from each side, and need not be clamped. */
static inline void find_cells(
    const field *f, const floats i, const floats j, const floats k, const int inner, cell_lanes *c)
{
    floats at_i = i, at_j = j, at_k = k;
    if (!inner) {
        at_i = lesser(greater(i, (floats)(0.0f)), (floats)(f->last.x));
        at_j = lesser(greater(j, (floats)(0.0f)), (floats)(f->last.y));
        at_k = lesser(greater(k, (floats)(0.0f)), (floats)(f->last.z));
    }
    c->i = to_ints(at_i);
    c->j = to_ints(at_j);
    c->k = to_ints(at_k);
    if (!inner) {
        c->i = lesser_int(c->i, (ints)(f->ni - 2));
        c->j = lesser_int(c->j, (ints)(f->nj - 2));
        c->k = lesser_int(greater_int(c->k, (ints)(f->first_k)), (ints)(f->end_k - 2));
    }
    c->part_i = at_i - to_floats(c->i);
    c->part_j = at_j - to_floats(c->j);
    c->part_k = at_k - to_floats(c->k);
}

#if HAS_WINDOWS
#ifdef LEAST_VALUE
static inline short16 hold_pairs(const short16 pairs)
{
    const short16 least = (short)(LEAST_VALUE);
    return pairs > least ? pairs : least;
}
#endif

/* True where all cells of `inner` places lie in one row, and one window holds them and the voxels beside them; sets
 * `row` and `at` then.  Rows have at least WINDOW voxels. */
static inline int find_window(const field *f, cell_lanes *c)
{
    const int j = c->j.s0, k = c->k.s0;
    const int least = c->i.s0 < c->i.s7 ? c->i.s0 : c->i.s7;
    const int begin = (least < f->ni - WINDOW + 1 ? least : f->ni - WINDOW + 1) - 1;
    c->at = c->i - begin;
    if (ANY_LANE((c->j != j) | (c->k != k) | (as_uint8(c->at - 1) > (uint)(WINDOW - 4))))
        return 0;
    c->row = f->voxels + voxel_index(begin, j, k - f->first_k, f->ni, f->nj);
    return 1;
}

/* Prefetch the voxels of the next cell of the first lane: rows are too far apart for the prefetchers of CPUs. */
static inline void fetch_cell_early(const field *f, const float i, const float j, const float k)
{
    const size_t slice = (size_t)f->ni * f->nj;
    __global const VOXEL *corner = f->voxels + voxel_index((int)i, (int)j, (int)k - f->first_k, f->ni, f->nj);
    fetch_early(corner);
    fetch_early(corner + f->ni);
    fetch_early(corner + slice);
    fetch_early(corner + slice + f->ni);
}

static inline floats sample_window(const field *f, const cell_lanes *c)
{
    const int row = f->ni, slice = f->ni * f->nj;
    const choice pairs = choose_pairs(c->at);
    const short16 weights = weigh_pairs(c->part_i);
#define EDGE(to_row) to_floats(mix_pairs(HOLD_PAIRS(take_pairs(c->row + (to_row), pairs)), weights))
    const floats front_near = EDGE(0), front_far = EDGE(row);
    const floats back_near = EDGE(slice), back_far = EDGE(slice + row);
#undef EDGE
    const floats front = front_near + c->part_j * (front_far - front_near);
    const floats back = back_near + c->part_j * (back_far - back_near);
    return (front + c->part_k * (back - front)) * (1.0f / SHARES);
}

static inline void find_window_slopes(const field *f, const cell_lanes *c, slopes *s)
{
    const int row = f->ni, slice = f->ni * f->nj;
    const choice pairs = choose_pairs(c->at), to_left = next_pairs(pairs, -1), to_right = next_pairs(pairs, 1);
    const short16 weights = weigh_pairs(c->part_i);
    const floats far = c->part_j * (0.5f / SHARES), near = 0.5f / SHARES - far;
#define EDGE(to_row) to_floats(mix_pairs(take_pairs(c->row + (to_row), pairs), weights))
#define RISE(to_row) \
    to_floats(mix_pairs(take_pairs(c->row + (to_row), to_right), weights) \
        - mix_pairs(take_pairs(c->row + (to_row), to_left), weights))
    const floats value_00 = EDGE(0), value_10 = EDGE(row), value_01 = EDGE(slice), value_11 = EDGE(slice + row);
    s->below_i = near * RISE(0) + far * RISE(row);
    s->above_i = near * RISE(slice) + far * RISE(slice + row);
    s->below_j = near * (value_10 - EDGE(-row)) + far * (EDGE(2 * row) - value_00);
    s->above_j = near * (value_11 - EDGE(slice - row)) + far * (EDGE(slice + 2 * row) - value_01);
    s->below_k = near * (value_01 - EDGE(-slice)) + far * (value_11 - EDGE(row - slice));
    s->above_k = near * (EDGE(2 * slice) - value_00) + far * (EDGE(2 * slice + row) - value_10);
    s->share = c->part_k;
#undef EDGE
#undef RISE
}
#endif

static inline floats sample_held_edge(__global const VOXEL *row, const ints at, const floats part)
{
    floats low, high;
    LOAD_PAIRS(row, at, low, high)
    low = HOLD_FLOATS(low);
    high = HOLD_FLOATS(high);
    return low + part * (high - low);
}

/* Values at LANES places near each other, index coordinates; `inner` as in find_cells(), 0 where that is not known. */
static inline floats sample_lanes(const field *f, const floats i, const floats j, const floats k, const int inner)
{
    cell_lanes c;
    find_cells(f, i, j, k, inner, &c);
#if HAS_WINDOWS
    if (inner && find_window(f, &c))
        return sample_window(f, &c);
#endif
    /* Lanes lie near each other, so what they differ by is a small number. */
    const int base_i = FIRST_LANE(c.i), base_j = FIRST_LANE(c.j), base_k = FIRST_LANE(c.k);
    __global const VOXEL *corner = f->voxels + voxel_index(base_i, base_j, base_k - f->first_k, f->ni, f->nj);
    const ints at = ((c.k - base_k) * f->nj + (c.j - base_j)) * f->ni + (c.i - base_i);
    const int row = f->ni, slice = f->ni * f->nj;
    const floats front_near = sample_held_edge(corner, at, c.part_i);
    const floats front_far = sample_held_edge(corner + row, at, c.part_i);
    const floats back_near = sample_held_edge(corner + slice, at, c.part_i);
    const floats back_far = sample_held_edge(corner + slice + row, at, c.part_i);
    const floats front = front_near + c.part_j * (front_far - front_near);
    const floats back = back_near + c.part_j * (back_far - back_near);
    return front + c.part_k * (back - front);
}

/* A row of four voxels about a cell's edge along i: value and twice the slope. */
static inline void sample_row(__global const VOXEL *row, const ints at, const ints to_left, const ints to_right,
    const floats part, floats *value, floats *slope)
{
    floats left, low, high, right;
    LOAD_PAIRS(row, at + to_left, left, low)
    LOAD_PAIRS(row, at + to_right, high, right)
    /* At the border both pairs are the edge's own. */
    const floats first = choose(to_left < 0, low, left), second = choose(to_right > 0, high, right);
    *value = first + part * (second - first);
    *slope = (second - left) + part * ((right - first) - (second - left));
}

static inline floats sample_edge(__global const VOXEL *row, const ints at, const floats part)
{
    floats low, high;
    LOAD_PAIRS(row, at, low, high)
    return low + part * (high - low);
}

static inline void find_slopes(
    const field *f, const floats i, const floats j, const floats k, const int inner, slopes *s)
{
    cell_lanes c;
    find_cells(f, i, j, k, inner, &c);
#if HAS_WINDOWS
    if (inner && find_window(f, &c)) {
        find_window_slopes(f, &c, s);
        return;
    }
#endif
    const floats part = c.part_i, far = c.part_j, near = 1.0f - far;
    const int base_i = FIRST_LANE(c.i), base_j = FIRST_LANE(c.j), base_k = FIRST_LANE(c.k);
    __global const VOXEL *corner = f->voxels + voxel_index(base_i, base_j, base_k - f->first_k, f->ni, f->nj);
    const ints at = ((c.k - base_k) * f->nj + (c.j - base_j)) * f->ni + (c.i - base_i);
    const int row = f->ni, slice = f->ni * f->nj;
    const ints to_left = choose(c.i > 0, (ints)(-1), (ints)(0));
    const ints to_right = choose(c.i + 2 < f->ni, (ints)(1), (ints)(0));
    /* Rows beside the cell, and those under and over it: its own at the border. */
    const ints down = at + choose(c.j > 0, (ints)(-row), (ints)(0));
    const ints up = at + choose(c.j + 2 < f->nj, (ints)(2 * row), (ints)(row));
    const ints under = at + choose(c.k > f->first_k, (ints)(-slice), (ints)(0));
    const ints over = at + choose(c.k + 2 < f->end_k, (ints)(2 * slice), (ints)(slice));
    floats value_00, value_10, value_01, value_11, slope_00, slope_10, slope_01, slope_11;
    sample_row(corner, at, to_left, to_right, part, &value_00, &slope_00);
    sample_row(corner + row, at, to_left, to_right, part, &value_10, &slope_10);
    sample_row(corner + slice, at, to_left, to_right, part, &value_01, &slope_01);
    sample_row(corner + slice + row, at, to_left, to_right, part, &value_11, &slope_11);
    s->below_i = 0.5f * (near * slope_00 + far * slope_10);
    s->above_i = 0.5f * (near * slope_01 + far * slope_11);
    s->below_j = 0.5f
        * (near * (value_10 - sample_edge(corner, down, part)) + far * (sample_edge(corner, up, part) - value_00));
    s->above_j = 0.5f
        * (near * (value_11 - sample_edge(corner + slice, down, part))
            + far * (sample_edge(corner + slice, up, part) - value_01));
    const floats low = near * value_00 + far * value_10, high = near * value_01 + far * value_11;
    s->below_k = 0.5f
        * (high - near * sample_edge(corner, under, part) - far * sample_edge(corner + row, under, part));
    s->above_k = 0.5f
        * (near * sample_edge(corner, over, part) + far * sample_edge(corner + row, over, part) - low);
    s->share = c.part_k;
}

/* The differences that belong to these values, at one place. */
static inline void mix_slopes(const slopes *s, floats *along_i, floats *along_j, floats *along_k)
{
    *along_i = s->below_i + s->share * (s->above_i - s->below_i);
    *along_j = s->below_j + s->share * (s->above_j - s->below_j);
    *along_k = s->below_k + s->share * (s->above_k - s->below_k);
}

#endif
