/* Non-local means of slices: each voxel becomes the mean of those around it whose surroundings look like its own.
 *
 *     v'(p) = v(p) + sum_t w_t d_t / sum_t w_t,   d_t = v(p + t) - v(p),   w_t = exp2(-scale max(s_t - noise, 0))
 *
 * s_t is the sum of the squared differences between the patch of voxels around p and the one around p + t; of an even side
 * the larger half follows p.  The steps t go over a square around p; w_0 is 1, and those below exp(-5) are 0.  Each slice
 * lies in a frame of mirrored voxels:
 *
 *       .---------------------.     padding = reach + half a patch
 *       |  frame              |
 *       |   .-------------.   |     A work-item with LANES = 8 makes a tile of WIDTH x HEIGHT voxels, with LANES = 1 a
 *       |   | slice       |   |     voxel.  Both add in the same order: each column of a patch from its first row on,
 *       |   '-------------'   |     then the columns from the first one on.
 *       |                     |
 *       '---------------------'
 *
 * Reference: A. Buades, B. Coll, J.-M. Morel, "A non-local algorithm for image denoising", 2005; J. Darbon et al., "Fast
 * nonlocal filtering applied to electron cryomicroscopy", 2008 (sums that patches share), the form of scikit-image.
 *
 * Passes
 *   1. average_patches   in turn for some of the steps
 *   2. finish_means      once */
#include "filters/power_of_two.h"

#define WIDTH 64  /* voxels of a tile along i */
#define HEIGHT 16 /* and along j */
#define MOST_PATCH 31
#define SUMS_WIDTH 96 /* columns of a tile and of the patches beyond it, in whole vectors */
#define SCRATCH 6048  /* floats of a tile: SUMS_WIDTH * (2 HEIGHT + MOST_PATCH) */
#define LARGEST_EXPONENT 7.2134752f /* 5 / ln 2: weights beyond it are 0 */

/* Weights of patches by their sums. */
static inline floats weigh(const floats sums, const float noise, const float scale)
{
    const floats exponent = greater(sums - (floats)(noise), (floats)(0.0f)) * scale;
    const floats weights = power_of_two(-lesser(exponent, (floats)(LARGEST_EXPONENT)));
    return choose(exponent <= LARGEST_EXPONENT, weights, (floats)(0.0f));
}

/* What an item does.  own: its first voxel, in the frame. */
typedef struct {
    __global const float *own;
    uint pitch;
    int reach, patch;
    float noise, scale;
} means;

/* The other voxels of the square, and how far each is in memory. */
static inline int count_steps(const means *of) { return (2 * of->reach + 1) * (2 * of->reach + 1) - 1; }

static inline int find_step(const means *of, const int number)
{
    const int width = 2 * of->reach + 1, place = number < count_steps(of) / 2 ? number : number + 1;
    return (place / width - of->reach) * (int)of->pitch + place % width - of->reach;
}

#if LANES == 8
#define ITEM_WIDTH WIDTH
#define ITEM_HEIGHT HEIGHT
/* Squares of the differences between a tile with the patches beyond it and that `step` away, and sums of their columns. */
static inline void add_columns(const means *of, const int step, __global float *squares, __global float *sums)
{
    const uint before = ((uint)of->patch - 1u) / 2u, width = WIDTH + (uint)of->patch - 1u;
    __global const float *first = of->own - before * of->pitch - before;
    for (uint row = 0; row < HEIGHT + (uint)of->patch - 1u; ++row)
        for (uint column = 0; column < width; column += 8u) {
            __global const float *at = first + row * of->pitch + column;
            const floats away = load_lanes(at + step) - load_lanes(at);
            store_lanes(away * away, squares + row * SUMS_WIDTH + column);
        }
    for (uint row = 0; row < HEIGHT; ++row)
        for (uint column = 0; column < width; column += 8u) {
            __global const float *at = squares + row * SUMS_WIDTH + column;
            floats sum = load_lanes(at);
            for (int further = 1; further < of->patch; ++further)
                sum += load_lanes(at + further * SUMS_WIDTH);
            store_lanes(sum, sums + row * SUMS_WIDTH + column);
        }
}

/* Add what the voxels `step` away weigh, and their differences. */
static inline void add_weights(
    const means *of, const int step, __global const float *sums, __global float *weights, __global float *changes)
{
    for (uint row = 0; row < HEIGHT; ++row)
        for (uint column = 0; column < WIDTH; column += 8u) {
            __global const float *at = sums + row * SUMS_WIDTH + column;
            __global const float *voxels = of->own + row * of->pitch + column;
            const uint entry = row * WIDTH + column;
            floats sum = load_lanes(at);
            for (int further = 1; further < of->patch; ++further)
                sum += load_lanes(at + further);
            const floats weight = weigh(sum, of->noise, of->scale);
            const floats away = load_lanes(voxels + step) - load_lanes(voxels);
            store_lanes(load_lanes(weights + entry) + weight, weights + entry);
            store_lanes(fused(weight, away, load_lanes(changes + entry)), changes + entry);
        }
}

static inline void add_steps(
    const means *of, __global float *scratch, __global float *weights, __global float *changes, const int first,
    const int end)
{
    for (uint entry = 0; first == 0 && entry < WIDTH * HEIGHT; entry += 8u) {
        store_lanes((floats)(1.0f), weights + entry);
        store_lanes((floats)(0.0f), changes + entry);
    }
    for (int number = first; number < end; ++number) {
        const int step = find_step(of, number);
        add_columns(of, step, scratch, scratch + SUMS_WIDTH * (HEIGHT + MOST_PATCH));
        add_weights(of, step, scratch + SUMS_WIDTH * (HEIGHT + MOST_PATCH), weights, changes);
    }
}
#else
#define ITEM_WIDTH 1
#define ITEM_HEIGHT 1
static inline float add_patch(const means *of, __global const float *first, const int step)
{
    float all = 0.0f;
    for (int column = 0; column < of->patch; ++column) {
        float sum = 0.0f;
        for (int row = 0; row < of->patch; ++row) {
            __global const float *at = first + row * (int)of->pitch + column;
            const float away = at[step] - at[0];
            sum += away * away;
        }
        all += sum;
    }
    return all;
}

static inline void add_steps(
    const means *of, __global float *scratch, __global float *weights, __global float *changes, const int first,
    const int end)
{
    const int before = (of->patch - 1) / 2;
    __global const float *patch = of->own - before * (int)of->pitch - before;
    float weight_sum = first == 0 ? 1.0f : weights[0], change = first == 0 ? 0.0f : changes[0];
    for (int number = first; number < end; ++number) {
        const int step = find_step(of, number);
        const float weight = weigh(add_patch(of, patch, step), of->noise, of->scale);
        weight_sum += weight;
        change = fused(weight, of->own[step] - of->own[0], change);
    }
    weights[0] = weight_sum;
    changes[0] = change;
}
#endif

/* Parameters  padded    in   (slices, height, pitch) voxels in their frames; height and pitch hold whole tiles, and 8
 *                       floats more follow the last
 *             scratch   out  with LANES = 8 (items, SCRATCH) floats
 *             weights   in and out  sums of weights, of the voxels of each item in turn; out alone where first is 0
 *             changes   in and out  likewise, of weights times differences
 *             pitch, height
 *             columns, rows   items along i and along j in a slice
 *             items
 *             reach     voxels from the middle to the end of the square
 *             patch     voxels of a side of a patch, at most MOST_PATCH
 *             noise     what sums may be without losing weight
 *             scale     exponents of 2 for each unit of a sum beyond it
 *             first, end   steps that are added, of (2 reach + 1)^2 - 1
 * Launch      global = items, rounded up by the host, any local.  Few steps at a time: llvmpipe ends a work-item's loops
 *             after 65,535 iterations in all
 * Assumes     the frame is reach + patch / 2 wide
 * Guarantees  written for every voxel of the items */
__kernel void average_patches(
    __global const float *restrict padded, __global float *restrict scratch, __global float *restrict weights,
    __global float *restrict changes, const uint pitch, const uint height, const uint columns, const uint rows,
    const uint items, const int reach, const int patch, const float noise, const float scale, const int first,
    const int end)
{
    const uint item = get_global_id(0);
    if (item >= items)
        return;
    const uint slice = item / (columns * rows), tile = item - slice * columns * rows;
    const uint i = tile % columns * ITEM_WIDTH, j = tile / columns * ITEM_HEIGHT, frame = (uint)(reach + patch / 2);
    const means of = {
        padded + (ulong)slice * height * pitch + (ulong)(j + frame) * pitch + i + frame, pitch, reach, patch, noise, scale};
    const ulong entry = (ulong)item * (ITEM_WIDTH * ITEM_HEIGHT);
    add_steps(&of, scratch + (ulong)item * SCRATCH, weights + entry, changes + entry, first, end);
}

/* Parameters  padded, weights, changes, pitch, height, columns, rows   in   as above
 *             filtered  out  (slices, nj, ni)
 *             ni, nj
 *             voxels    slices * nj * ni
 *             frame     voxels around each slice
 * Launch      global = voxels, rounded up by the host, any local
 * Assumes     all steps were added
 * Guarantees  written for every voxel */
__kernel void finish_means(
    __global const float *restrict padded, __global const float *restrict weights,
    __global const float *restrict changes, __global float *restrict filtered, const uint ni, const uint nj,
    const uint voxels, const uint pitch, const uint height, const uint columns, const uint rows, const uint frame)
{
    const uint voxel = get_global_id(0);
    if (voxel >= voxels)
        return;
    const uint i = voxel % ni, j = voxel / ni % nj, slice = voxel / ni / nj;
    const uint item = (slice * rows + j / ITEM_HEIGHT) * columns + i / ITEM_WIDTH;
    const ulong entry = (ulong)item * (ITEM_WIDTH * ITEM_HEIGHT) + j % ITEM_HEIGHT * ITEM_WIDTH + i % ITEM_WIDTH;
    const float own = padded[(ulong)slice * height * pitch + (ulong)(j + frame) * pitch + i + frame];
    filtered[voxel] = own + changes[entry] / weights[entry];
}
