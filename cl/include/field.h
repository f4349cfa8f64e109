/* The trilinear field of a volume: values for LANES places at once, gradients for one.
 *
 * Half a voxel around the outermost voxel centres belongs to the volume and has the nearest centre's value. */
#ifndef CLRECON_FIELD_H
#define CLRECON_FIELD_H

#include "include/lanes.h"
#include "include/volume.h"

/* A volume, or the slices of it from first_k to end_k - 1 that a device holds: at least two along each axis. */
typedef struct {
    __global const VOXEL *voxels;
    int ni, nj; /* of the buffer */
    int first_k, end_k;
    float4 last; /* indices of the last voxel centres of the whole volume, along i, j, k */
} field;

#ifndef VOXEL_IS_SHORT
#define VOXEL_IS_SHORT 0 /* VOXEL is short: two of them are one int */
#endif

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

/* Values at LANES places near each other, index coordinates. */
static inline floats sample_lanes(const field *f, const floats i, const floats j, const floats k)
{
    const floats at_i = min(max(i, (floats)(0.0f)), (floats)(f->last.x));
    const floats at_j = min(max(j, (floats)(0.0f)), (floats)(f->last.y));
    const floats at_k = min(max(k, (floats)(0.0f)), (floats)(f->last.z));
    const ints cell_i = min(to_ints(at_i), (ints)(f->ni - 2));
    const ints cell_j = min(to_ints(at_j), (ints)(f->nj - 2));
    const ints cell_k = clamp(to_ints(at_k), (ints)(f->first_k), (ints)(f->end_k - 2));
    const floats part_i = at_i - to_floats(cell_i), part_j = at_j - to_floats(cell_j);
    const floats part_k = at_k - to_floats(cell_k);
    /* Lanes lie near each other, so what they differ by is a small number. */
    const int base_i = FIRST_LANE(cell_i), base_j = FIRST_LANE(cell_j), base_k = FIRST_LANE(cell_k);
    __global const VOXEL *corner = f->voxels + voxel_index(base_i, base_j, base_k - f->first_k, f->ni, f->nj);
    const ints at = ((cell_k - base_k) * f->nj + (cell_j - base_j)) * f->ni + (cell_i - base_i);
    const int row = f->ni, slice = f->ni * f->nj;
    floats low, high;
    LOAD_PAIRS(corner, at, low, high)
    const floats front_near = low + part_i * (high - low);
    LOAD_PAIRS(corner + row, at, low, high)
    const floats front_far = low + part_i * (high - low);
    LOAD_PAIRS(corner + slice, at, low, high)
    const floats back_near = low + part_i * (high - low);
    LOAD_PAIRS(corner + slice + row, at, low, high)
    const floats back_far = low + part_i * (high - low);
    const floats front = front_near + part_j * (front_far - front_near);
    const floats back = back_near + part_j * (back_far - back_near);
    return front + part_k * (back - front);
}

/* Differences per index step at LANES places, interpolated within the slices below and above each: central differences
 * of voxels, half a one-sided difference at the border. */
typedef struct {
    floats below_i, below_j, below_k, above_i, above_j, above_k;
    floats share; /* of the slice above */
} slopes;

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

static inline void find_slopes(const field *f, const floats i, const floats j, const floats k, slopes *s)
{
    const floats at_i = min(max(i, (floats)(0.0f)), (floats)(f->last.x));
    const floats at_j = min(max(j, (floats)(0.0f)), (floats)(f->last.y));
    const floats at_k = min(max(k, (floats)(0.0f)), (floats)(f->last.z));
    const ints cell_i = min(to_ints(at_i), (ints)(f->ni - 2));
    const ints cell_j = min(to_ints(at_j), (ints)(f->nj - 2));
    const ints cell_k = clamp(to_ints(at_k), (ints)(f->first_k), (ints)(f->end_k - 2));
    const floats part = at_i - to_floats(cell_i), far = at_j - to_floats(cell_j), near = 1.0f - far;
    const int base_i = FIRST_LANE(cell_i), base_j = FIRST_LANE(cell_j), base_k = FIRST_LANE(cell_k);
    __global const VOXEL *corner = f->voxels + voxel_index(base_i, base_j, base_k - f->first_k, f->ni, f->nj);
    const ints at = ((cell_k - base_k) * f->nj + (cell_j - base_j)) * f->ni + (cell_i - base_i);
    const int row = f->ni, slice = f->ni * f->nj;
    const ints to_left = choose(cell_i > 0, (ints)(-1), (ints)(0));
    const ints to_right = choose(cell_i + 2 < f->ni, (ints)(1), (ints)(0));
    /* Rows beside the cell, and those under and over it: its own at the border. */
    const ints down = at + choose(cell_j > 0, (ints)(-row), (ints)(0));
    const ints up = at + choose(cell_j + 2 < f->nj, (ints)(2 * row), (ints)(row));
    const ints under = at + choose(cell_k > f->first_k, (ints)(-slice), (ints)(0));
    const ints over = at + choose(cell_k + 2 < f->end_k, (ints)(2 * slice), (ints)(slice));
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
    s->share = at_k - to_floats(cell_k);
}

/* The same as differences at one place. */
static inline void mix_slopes(const slopes *s, floats *along_i, floats *along_j, floats *along_k)
{
    *along_i = s->below_i + s->share * (s->above_i - s->below_i);
    *along_j = s->below_j + s->share * (s->above_j - s->below_j);
    *along_k = s->below_k + s->share * (s->above_k - s->below_k);
}

#endif
