/* The index formula of volumes, and reading of voxels inside and beyond the border.
 *
 * VOXEL is the element type of the volume (-D VOXEL=short ...): char, uchar, short, ushort, int or float.
 * VALUE is the type for values and their differences: int for integer voxels, else float. */
#ifndef CLRECON_VOLUME_H
#define CLRECON_VOLUME_H

#ifndef VOXEL
#define VOXEL short
#endif
#ifndef VALUE
#define VALUE int
#endif

#define CLRECON_JOIN(a, b) a##b
#define CLRECON_VECTOR(type, n) CLRECON_JOIN(type, n)
#define VOXEL8 CLRECON_VECTOR(VOXEL, 8)

/* Linear index of voxel (i, j, k) of a volume of ni columns and nj rows a slice: i runs fastest. */
static inline size_t voxel_index(int i, int j, int k, int ni, int nj)
{
    return ((size_t)k * (size_t)nj + (size_t)j) * (size_t)ni + (size_t)i;
}

/* A volume, or the slices of it from first_k on that a device holds. */
typedef struct {
    __global const VOXEL *voxels;
    int ni, nj, nk; /* of the whole volume */
    int first_k; /* slice that `voxels` begins with */
    int closed; /* surrounded by `outside`; else by the nearest voxel's value */
    VALUE outside;
} volume_part;

/* Value at (i, j, k), which may lie beyond the border of the volume. */
static inline VALUE sample_volume(const volume_part *volume, int i, int j, int k)
{
    const int ni = volume->ni, nj = volume->nj, nk = volume->nk;
    const int beyond = (i < 0) | (i >= ni) | (j < 0) | (j >= nj) | (k < 0) | (k >= nk);
    if (volume->closed && beyond)
        return volume->outside;
    const int inside_k = clamp(k, 0, nk - 1) - volume->first_k;
    return volume->voxels[voxel_index(clamp(i, 0, ni - 1), clamp(j, 0, nj - 1), inside_k, ni, nj)];
}

#endif
