/* The one index formula, and reading a voxel inside and beyond the border of a volume.
 *
 * VOXEL is the element type of the volume (-D VOXEL=short ...): char, uchar, short, ushort, int or float. */
#ifndef CLRECON_VOLUME_H
#define CLRECON_VOLUME_H

#ifndef VOXEL
#define VOXEL short
#endif

/* Linear index of voxel (i, j, k) of a volume of ni columns and nj rows a slice: i runs fastest. */
static inline size_t voxel_index(int i, int j, int k, int ni, int nj)
{
    return ((size_t)k * (size_t)nj + (size_t)j) * (size_t)ni + (size_t)i;
}

/* Value at (i, j, k); beyond the border of a closed volume `outside`, of an open one the nearest voxel's. */
static inline float sample_voxel(
    __global const VOXEL *voxels, int i, int j, int k, int ni, int nj, int nk, int closed, float outside)
{
    const int beyond = (i < 0) | (i >= ni) | (j < 0) | (j >= nj) | (k < 0) | (k >= nk);
    if (closed && beyond)
        return outside;
    return convert_float(voxels[voxel_index(clamp(i, 0, ni - 1), clamp(j, 0, nj - 1), clamp(k, 0, nk - 1), ni, nj)]);
}

#endif
