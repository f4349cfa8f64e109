/* The bilateral filter of a volume: each voxel becomes the mean of its neighbours, weighted by distance in mm and by
 * difference in HU.
 *
 *     v'(p) = v(p) + sum_t w_t d_t / (1 + sum_t w_t),   d_t = v(p + t) - v(p),   w_t = exp2(s_t - c d_t^2)
 *
 * s_t is the exponent of the distance, -|t|^2 log2(e) / (2 sigma_mm^2), and c = log2(e) / (2 sigma_hu^2).  The taps t
 * of the window, all but the voxel itself, stand in rows: those with the same steps along j and k are neighbours along i.  Voxels beyond the
 * volume have the value of the nearest voxel in it.  NaN and infinite voxels stay, and count nowhere.
 *
 * A work-item with LANES = 8 makes a group of 16 voxels along i, with LANES = 1 a voxel.  So that no group has to ask
 * where its row ends, the first and last ones read from strips, which go on beyond the row:
 *
 *     row of voxels        0 1 2 3 ............................ ni - 1
 *     strip of group 0     0 0 0 1 2 3 .... 15 16 17              (reach = 2: the first voxel, repeated)
 *     groups within        read the row itself
 *     strip of the last    ............................ ni - 1, ni - 1, ni - 1
 *
 * Reference: Tomasi and Manduchi 1998, "Bilateral filtering for gray and color images".
 *
 * Passes
 *   1. copy_row_ends
 *   2. filter_bilateral   all groups, or those of a list (cl/filters/near_level.cl) */
#include "include/lanes.h"
#include "filters/power_of_two.h"
#include "include/volume.h"

#define GROUP 16 /* voxels of a group */
#define IS_FLOAT ((VALUE)0.5f > (VALUE)0)
#define LARGEST_FLOAT 3.40282347e38f
#define LEAST_EXPONENT -120.0f /* weights below are 0 but for rounding, and those of floats are 0 */

/* Sums over the taps for LANES voxels, and the lowest and highest value that counted, for floats alone. */
typedef struct {
    floats weights, differences, low, high;
} tap_sums;

/* Differences count in units of 1 / range HU: for voxels of up to 16 bits it is one operation, exact to a unit in the
 * last place of the voxel's own value. */
static inline void add_tap(
    tap_sums *sums, const floats values, const floats centre, const floats scaled, const float spatial,
    const float range)
{
    floats away = sizeof(VOXEL) <= 2 ? fused(values, (floats)(range), -scaled) : (values - centre) * range;
    if (IS_FLOAT)
        away = choose(fabs(values) <= LARGEST_FLOAT, away, (floats)(0.0f));
    const floats exponent = fused(-away, away, (floats)(spatial));
    floats weight = power_of_two(greater(exponent, (floats)(LEAST_EXPONENT)));
    if (IS_FLOAT) {
        const ints counts = (fabs(values) <= LARGEST_FLOAT) & (exponent >= LEAST_EXPONENT);
        weight = choose(counts, weight, (floats)(0.0f));
        away = choose(counts, away, (floats)(0.0f)); /* it may be infinite */
        sums->low = choose(counts, lesser(sums->low, values), sums->low);
        sums->high = choose(counts, greater(sums->high, values), sums->high);
    }
    sums->weights += weight;
    sums->differences = fused(weight, away, sums->differences);
}

/* The new values; whole numbers are rounded, halves away from the old value.  Floats stay between the values that
 * counted, which the last rounding might leave: what was on one side of a level with its whole window stays there. */
static inline floats finish_value(const tap_sums *sums, const floats centre, const float range)
{
    const floats change = sums->differences / (sums->weights * range);
    if (IS_FLOAT) {
        const floats value = lesser(greater(centre + change, sums->low), sums->high);
        return choose(fabs(centre) <= LARGEST_FLOAT, value, centre);
    }
    return to_floats(to_ints(change + choose(change < 0.0f, (floats)(-0.5f), (floats)(0.5f)))) + centre;
}

/* LANES voxels that are filtered. */
typedef struct {
    floats centre, scaled; /* their values, and those in units of 1 / range HU */
    tap_sums sums;
} lanes_of_voxels;

static inline void start_lanes(lanes_of_voxels *lanes, __global const VOXEL *own, const float range)
{
    const floats centre = to_floats(load_lanes(own));
    const tap_sums sums = {1.0f, 0.0f, centre, centre}; /* the voxel itself, which is no tap */
    lanes->centre = centre;
    lanes->scaled = centre * range;
    lanes->sums = sums;
}

/* Add taps by their steps from the voxels at `own`. */
static inline void add_steps_to_lanes(
    lanes_of_voxels *lanes, __global const VOXEL *own, __global const int *steps, __global const float *spatial,
    const int count, const float range)
{
    for (int t = 0; t < count; ++t)
        add_tap(&lanes->sums, to_floats(load_lanes(own + steps[t])), lanes->centre, lanes->scaled, spatial[t], range);
}

/* Add a row of taps, the first of which is at `near`. */
static inline void add_row_to_lanes(
    lanes_of_voxels *lanes, __global const VOXEL *near, __global const float *spatial, const int count,
    const float range)
{
    for (int t = 0; t < count; ++t)
        add_tap(&lanes->sums, to_floats(load_lanes(near + t)), lanes->centre, lanes->scaled, spatial[t], range);
}

/* The voxels of an item: a group, or one. */
#if LANES == 8
#define VOXELS_OF_ITEM GROUP
typedef struct {
    lanes_of_voxels first, second;
} item_voxels;

static inline void start_voxels(item_voxels *voxels, __global const VOXEL *own, const float range)
{
    start_lanes(&voxels->first, own, range);
    start_lanes(&voxels->second, own + LANES, range);
}

static inline void add_steps(
    item_voxels *voxels, __global const VOXEL *own, __global const int *steps, __global const float *spatial,
    const int count, const float range)
{
    add_steps_to_lanes(&voxels->first, own, steps, spatial, count, range);
    add_steps_to_lanes(&voxels->second, own + LANES, steps, spatial, count, range);
}

static inline void add_row(
    item_voxels *voxels, __global const VOXEL *near, __global const float *spatial, const int count, const float range)
{
    add_row_to_lanes(&voxels->first, near, spatial, count, range);
    add_row_to_lanes(&voxels->second, near + LANES, spatial, count, range);
}

/* Store the first `count` voxels. */
static inline void store_voxels(const item_voxels *voxels, __global VOXEL *to, const int count, const float range)
{
    const VOXEL8 first
        = CLRECON_VECTOR(convert_, VOXEL8)(finish_value(&voxels->first.sums, voxels->first.centre, range));
    const VOXEL8 second
        = CLRECON_VECTOR(convert_, VOXEL8)(finish_value(&voxels->second.sums, voxels->second.centre, range));
    if (count == GROUP) {
        vstore8(first, 0, to);
        vstore8(second, 1, to);
        return;
    }
    VOXEL lanes[GROUP];
    vstore8(first, 0, lanes);
    vstore8(second, 1, lanes);
    for (int n = 0; n < count; ++n)
        to[n] = lanes[n];
}
#else
#define VOXELS_OF_ITEM 1
typedef lanes_of_voxels item_voxels;
#define start_voxels start_lanes
#define add_steps add_steps_to_lanes
#define add_row add_row_to_lanes

static inline void store_voxels(const item_voxels *voxels, __global VOXEL *to, const int count, const float range)
{
    *to = (VOXEL)finish_value(&voxels->sums, voxels->centre, range);
}
#endif

/* Parameters  voxels    in   slices of the volume
 *             ends      out  (rows, strips, GROUP + 2 reach) strips for the groups 0 to inner - 1 and from inner_end on
 *             ni        voxels a row;  rows  of the slices
 *             strips    a row
 *             inner, inner_end   groups that read the row itself
 *             reach     voxels that a window reaches beyond its group
 * Launch      global = rows strips rounded up by the host, any local
 * Guarantees  every voxel of the strips is written */
__kernel void copy_row_ends(
    __global const VOXEL *restrict voxels, __global VOXEL *restrict ends, const int ni, const uint rows,
    const uint strips, const uint inner, const uint inner_end, const int reach)
{
    const uint item = get_global_id(0);
    const uint row = item / strips, strip = item % strips;
    if (row >= rows)
        return;
    const int width = GROUP + 2 * reach;
    const int first = GROUP * (int)(strip < inner ? strip : inner_end + (strip - inner)) - reach;
    __global const VOXEL *from = voxels + (size_t)row * ni;
    __global VOXEL *to = ends + (size_t)item * width;
    for (int i = 0; i < width; ++i)
        to[i] = from[clamp(first + i, 0, ni - 1)];
}

/* Parameters  voxels     in   slices of the volume from first_k on
 *             ends       in   strips of all their rows, see copy_row_ends
 *             tap_rows   in   (row_count, 4) rows of taps: steps along j and k, first step along i, taps
 *             tap_steps  in   (steps,) steps to the taps in `voxels`
 *             spatial    in   exponents of distances, tap by tap; a table for each slice where they are uneven
 *             groups     in   numbers (j, k - core_k) row * row_groups + g of the groups to filter, where is_listed
 *             filtered   out  slices of the volume from core_k on; of a list, its groups alone are written
 *             range      sqrt(c): what a difference of 1 HU counts
 *             is_listed  0: every group is filtered
 *             first_entry, group_count  entries of the list, or groups of all core slices, from which on and up to
 *                        which this launch filters
 *             row_groups   groups a row: ceil(ni / GROUP), or what the list counts by
 *             ni nj nk   voxels of the whole volume
 *             first_k    slice that `voxels` begins with;  core_k  slice that `filtered` begins with
 *             row_count  rows of taps
 *             steps      taps;  inner_j, inner_k  rows and slices around a voxel that takes its taps by tap_steps
 *             table_taps   taps of a slice's table, 0 where all slices share one
 *             strips, inner, inner_end, reach   as copy_row_ends
 * Launch      LANES = 8: global = group_count - first_entry, LANES = 1: GROUP times as many; rounded up by the host,
 *             any local
 * Assumes     reach <= GROUP; all slices that windows reach are there; whole numbers lie within 2^24
 * Guarantees  the same bits for every list, every number of slices, and every driver that rounds fma() right */
__kernel void filter_bilateral(
    __global const VOXEL *restrict voxels, __global const VOXEL *restrict ends, __global const int4 *restrict tap_rows,
    __global const int *restrict tap_steps,
    __global const float *restrict spatial, __global const uint *restrict groups, __global VOXEL *restrict filtered,
    const float range, const int is_listed, const uint first_entry, const uint group_count, const uint row_groups, const int ni,
    const int nj, const int nk, const int first_k, const int core_k, const int row_count, const int steps,
    const int inner_j, const int inner_k, const int table_taps, const uint strips,
    const uint inner, const uint inner_end, const int reach)
{
    const uint item = get_global_id(0), items = GROUP / VOXELS_OF_ITEM; /* of a group */
    const uint entry = first_entry + item / items;
    const int lane = item % items;
    if (entry >= group_count)
        return;
    const uint number = is_listed ? groups[entry] : entry;
    const uint row = number / row_groups, g = number % row_groups;
    const int j = row % nj, core_slice = row / nj, k = core_k + core_slice;
    const int i = GROUP * (int)g + lane;
    const int count = min(GROUP, ni - GROUP * (int)g); /* voxels of the group */
    if (lane >= count)
        return;
    const int in_row = g >= inner && g < inner_end;
    const uint strip = g < inner ? g : inner + (g - inner_end);
    const size_t width = GROUP + 2 * reach;
    const size_t row_step = in_row ? (size_t)ni : strips * width;
    __global const VOXEL *base = in_row ? voxels + i : ends + strip * width + reach + lane;
    __global const VOXEL *own = base + ((size_t)(k - first_k) * nj + j) * row_step;
    __global const float *taps = spatial + (size_t)table_taps * k;

    item_voxels filtering;
    start_voxels(&filtering, own, range);
    const int tap_count = in_row && j >= inner_j && j + inner_j < nj && k >= inner_k && k + inner_k < nk ? steps : 0;
    add_steps(&filtering, own, tap_steps, taps, tap_count, range);
    for (int r = tap_count ? row_count : 0; r < row_count; ++r) {
        const int step_j = tap_rows[r].x, step_k = tap_rows[r].y, step_i = tap_rows[r].z, count_i = tap_rows[r].w;
        const int near_j = clamp(j + step_j, 0, nj - 1), near_k = clamp(k + step_k, 0, nk - 1) - first_k;
        __global const VOXEL *near = base + ((size_t)near_k * nj + near_j) * row_step + step_i;
        add_row(&filtering, near, taps, count_i, range);
        taps += count_i;
    }
    store_voxels(&filtering, filtered + voxel_index(i, j, core_slice, ni, nj), count, range);
}
