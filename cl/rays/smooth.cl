/* A volume smoothed by a Gaussian, one axis after the other: the field whose gradients light volume rendering.
 *
 * Gradients of the scan itself carry its noise and the steps of its voxels, and surfaces look like the grain of wood;
 * derivatives of a Gaussian are the usual remedy (Moeller et al. 1997, "A comparison of normal estimation schemes").
 *
 *      axis -->    .  .  o  o  X  o  o  .  .     voxel X with reach 2; beyond an end the outermost voxel counts */
#include "include/lanes.h"
#include "include/volume.h"

/* Values of LANES voxels of a row from i on; beyond its ends that of the outermost ones. */
#if LANES == 8
static inline floats load_voxels(__global const VOXEL *row, const int i, const int ni)
{
    if (i >= 0 && i + LANES <= ni)
        return to_floats(vload8(0, row + i));
    float value_of[LANES];
    for (int lane = 0; lane < LANES; ++lane)
        value_of[lane] = (float)row[clamp(i + lane, 0, ni - 1)];
    return load_lanes(value_of);
}
#else
static inline floats load_voxels(__global const VOXEL *row, const int i, const int ni)
{
    return (float)row[clamp(i, 0, ni - 1)];
}
#endif

/* Parameters  voxels    in   (nk, nj, ni)
 *             smoothed  out  the same
 *             weights   in   (reach + 1,) of a voxel, and of those at each distance on either side
 *             axis      along which is smoothed: 0 is i, 1 is j, 2 is k
 *             whole     values are rounded to whole numbers, halves down
 *             groups    LANES voxels side by side: ceil(ni / LANES) a row
 * Launch      global = groups * nj * nk rounded up by the host, any local
 * Assumes     whole numbers lie within 2^24
 * Guarantees  every voxel is written; the same bits on all devices: sums are taken outwards from each voxel */
__kernel void smooth_along(
    __global const VOXEL *restrict voxels, __global VOXEL *restrict smoothed, __global const float *restrict weights,
    const int reach, const int axis, const int whole, const int ni, const int nj, const int nk, const uint groups)
{
    const size_t item = get_global_id(0), row = item / groups;
    if (row >= (size_t)nj * nk)
        return;
    const int i = LANES * (int)(item % groups), j = (int)(row % nj), k = (int)(row / nj);
    const int place = axis == 1 ? j : k, last = (axis == 1 ? nj : nk) - 1;
    const size_t stride = axis == 1 ? (size_t)ni : (size_t)ni * nj;
    __global const VOXEL *own = voxels + row * ni;
    floats sum = weights[0] * load_voxels(own, i, ni);
    for (int step = 1; step <= reach; ++step) {
        floats before, after;
        if (axis == 0) {
            before = load_voxels(own, i - step, ni);
            after = load_voxels(own, i + step, ni);
        } else {
            before = load_voxels(own - (size_t)min(step, place) * stride, i, ni);
            after = load_voxels(own + (size_t)min(step, last - place) * stride, i, ni);
        }
        sum += weights[step] * (before + after);
    }
    float value_of[LANES];
    store_lanes(whole ? round_up(sum - 0.5f) : sum, value_of);
    for (int lane = 0; lane < LANES && i + lane < ni; ++lane)
        smoothed[row * ni + i + lane] = (VOXEL)value_of[lane];
}
