/* Gradients of a volume at points: differences of the trilinear field over half a voxel to either side.
 *
 *                 k + 1/2
 *                    |   j + 1/2          The three differences divide into the field's changes along the ways between
 *                    | /                  their ends.  Along i and j these are the steps of the volume; along k the way
 *      i - 1/2 ------+------ i + 1/2      goes from slice to slice, each where it is: uneven and sheared stacks need
 *                  / |                    nothing else.  With the ways a, b, c as columns of A,
 *          j - 1/2   |                        gradient = A^-T (differences) = (di b x c + dj c x a + dk a x b) / det A
 *                 k - 1/2
 *
 * Beyond the border the volume is surrounded by air.
 *
 * Passes
 *   1. find_gradients    once for each part of the volume that the device holds */
#include "include/volume.h"

static inline float between(const float a, const float b, const float share) { return a + (b - a) * share; }

/* Value of the trilinear field at (x, y, z) in index coordinates. */
static inline float trilinear_value(const volume_part *volume, const float x, const float y, const float z)
{
    const float low_x = floor(x), low_y = floor(y), low_z = floor(z);
    const float fx = x - low_x, fy = y - low_y, fz = z - low_z;
    const int i = (int)low_x, j = (int)low_y, k = (int)low_z;
    float of_slice[2];
    for (int s = 0; s < 2; ++s) {
        const float v00 = (float)sample_volume(volume, i, j, k + s), v10 = (float)sample_volume(volume, i + 1, j, k + s);
        const float v01 = (float)sample_volume(volume, i, j + 1, k + s);
        const float v11 = (float)sample_volume(volume, i + 1, j + 1, k + s);
        of_slice[s] = between(between(v00, v10, fx), between(v01, v11, fx), fy);
    }
    return between(of_slice[0], of_slice[1], fz);
}

/* Place of voxel (0, 0, k), mm; `origins` begins with slice -1. */
static inline float3 origin_at(__global const float *restrict origins, const float k, const int nk)
{
    const float within = clamp(k, -1.0f, (float)nk);
    const int layer = min((int)floor(within), nk - 1);
    const float3 origin = vload3(layer + 1, origins);
    return origin + (vload3(layer + 2, origins) - origin) * (within - (float)layer);
}

/* Parameters  voxels     in   the slices first_k and following of a volume of (nk, nj, ni)
 *             places     in   (points, 3) index coordinates
 *             origins    in   (nk + 2, 3) places of voxel (0, 0, k) from k = -1 on, mm
 *             gradients  out  (points, 3) HU per mm, LPS
 *             ni nj nk, first_k
 *             own_first, own_end   points in these layers are taken; those beyond the first and last slice belong to it
 *             step_i, step_j   mm
 *             outside    value beyond the border
 *             points
 * Launch      global = points rounded up by the host, any local
 * Assumes     slices own_first - 1 to own_end + 1 of the volume are there, places within 2^30
 * Guarantees  the gradient of every point of these layers is written */
__kernel void find_gradients(
    __global const VOXEL *restrict voxels, __global const float *restrict places, __global const float *restrict origins,
    __global float *restrict gradients, const int ni, const int nj, const int nk, const int first_k,
    const int own_first, const int own_end, const float4 step_i, const float4 step_j, const float outside,
    const uint points)
{
    const size_t point = get_global_id(0);
    if (point >= points)
        return;
    const float3 at = vload3(point, places);
    const int layer = clamp((int)floor(at.z), 0, nk - 1);
    if (layer < own_first || layer >= own_end)
        return;
    const volume_part volume = {voxels, ni, nj, nk, first_k, 1, (VALUE)outside};
    const float along_i = trilinear_value(&volume, at.x + 0.5f, at.y, at.z)
        - trilinear_value(&volume, at.x - 0.5f, at.y, at.z);
    const float along_j = trilinear_value(&volume, at.x, at.y + 0.5f, at.z)
        - trilinear_value(&volume, at.x, at.y - 0.5f, at.z);
    const float along_k = trilinear_value(&volume, at.x, at.y, at.z + 0.5f)
        - trilinear_value(&volume, at.x, at.y, at.z - 0.5f);
    const float3 a = step_i.xyz, b = step_j.xyz;
    const float3 c = origin_at(origins, at.z + 0.5f, nk) - origin_at(origins, at.z - 0.5f, nk);
    const float volume_of_steps = dot3(a, cross3(b, c));
    const float3 gradient = along_i * cross3(b, c) + along_j * cross3(c, a) + along_k * cross3(a, b);
    const float3 known = volume_of_steps != 0.0f ? gradient / volume_of_steps : (float3)(0.0f);
    vstore3(known, point, gradients);
}
