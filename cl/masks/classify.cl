/* The inside mask of a volume, one bit for each sample: the first pass of every surface.
 *
 * References: the packing is our own; skipping bricks by their ranges follows Wilhelms and Van Gelder 1992.
 *
 * Passes (one of them)
 *   classify_samples   from the voxels of a slab
 *   classify_bricks    from the voxels of mixed bricks alone, where the bricks of the whole volume are measured
 *
 * -D RANGE: inside are the voxels from `level` to `highest`, both included.
 * -D BORDER_INSIDE: the border counts as inside, so that inside samples enclose the others. */
#include "include/bricks.h"
#include "include/lanes.h"
#include "include/volume.h"
#include "include/mask_rows.h"

#ifdef HAS_BUILTIN_PREFETCH
#define PREFETCH(place) __builtin_prefetch((const void *)(size_t)(place))
#else
#define PREFETCH(place)
#endif

/* What the voxels are compared with. */
typedef struct {
    VOXEL level;
#ifdef RANGE
    VOXEL highest;
#endif
} inside_bounds;

/* The parameters of a kernel for the upper end of a range, and what it compares with. */
#ifdef RANGE
#define HIGHEST_PARAMETER , const VOXEL highest
#define BOUNDS { level, highest }
#define IS_INSIDE(values, bounds) ((values) >= (bounds).level & (values) <= (bounds).highest)
#else
#define HIGHEST_PARAMETER
#define BOUNDS { level }
#define IS_INSIDE(values, bounds) ((values) >= (bounds).level)
#endif

/* Inside bits of 16 voxels.  Wider types are compared 8 at a time: vectors of 64 bytes go wrong in PoCL 3.0 on
 * processors without registers of that size, where kernel and library disagree on how they are passed. */
static inline uint classify_lanes(__global const VOXEL *voxels, inside_bounds bounds)
{
    if (sizeof(VOXEL) <= 2)
        return pack_lanes(convert_short16(IS_INSIDE(vload16(0, voxels), bounds)));
    return pack_lanes((short16)(convert_short8(IS_INSIDE(vload8(0, voxels), bounds)),
        convert_short8(IS_INSIDE(vload8(1, voxels), bounds))));
}

/* The word of 32 samples that starts at voxel `first` of a row; `first` may lie before it, samples may lie beyond. */
static inline uint classify_word(__global const VOXEL *row, int first, int ni, inside_bounds bounds)
{
    if (ni < 32) {
        uint bits = 0;
        for (int b = max(0, -first); b < min(32, ni - first); ++b)
            bits |= (uint)(IS_INSIDE(row[first + b], bounds)) << b;
        return bits;
    }
    /* 32 voxels that lie in the row, shifted to where the word has them. */
    const int begin = clamp(first, 0, ni - 32);
    const uint bits = classify_lanes(row + begin, bounds) | classify_lanes(row + begin + 16, bounds) << 16;
    if (first < begin)
        return bits << (begin - first);
    return first - begin < 32 ? bits >> (first - begin) : 0;
}

/* Inside bits of 32 voxels that begin at a multiple of the size of a VOXEL8, which GPUs load as fast as one voxel. */
static inline uint classify_vectors(__global const VOXEL8 *voxels, inside_bounds bounds)
{
    const short8 first = convert_short8(IS_INSIDE(voxels[0], bounds));
    const short8 second = convert_short8(IS_INSIDE(voxels[1], bounds));
    const short8 third = convert_short8(IS_INSIDE(voxels[2], bounds));
    const short8 fourth = convert_short8(IS_INSIDE(voxels[3], bounds));
    return pack_lanes((short16)(first, second)) | pack_lanes((short16)(third, fourth)) << 16;
}

/* Bits of word w of a row of ni voxels that belong to its border; all of the row's where it lies in the border. */
#ifdef BORDER_INSIDE
#define BORDER_IS_INSIDE 1
static inline uint border_bits(int w, int ni, int border, int row_in_volume)
{
    const ulong row = low_bits(clamp(ni + 2 * border - 32 * w, 0, 32));
    const ulong voxels = low_bits(clamp(ni + border - 32 * w, 0, 32)) & ~low_bits(clamp(border - 32 * w, 0, 32));
    return (uint)(row_in_volume ? row & ~voxels : row);
}
#else
#define BORDER_IS_INSIDE 0
static inline uint border_bits(int w, int ni, int border, int row_in_volume) { return 0; }
#endif

/* The first word of a row with a bit set, any number behind the row without one, and the word after the last, or 0. */
typedef struct {
    int begin, end;
} word_extent;

/* Store the word behind those that were stored. */
static inline void store_word(__global uint *row_mask, int w, uint bits, word_extent *extent)
{
    row_mask[w] = bits;
    extent->begin = bits != 0 ? min(extent->begin, w) : extent->begin;
    extent->end = bits != 0 ? w + 1 : extent->end;
}

/* Parameters  voxels     in   slices of the volume from first_slice on
 *             mask       out  (gk, gj, words) bit set where voxel >= level
 *             row_extents  out  (gk, gj) first word of the row with a bit set, and the one after the last; 0, 0 in
 *                          rows without any
 *             level      lowest inside value
 *             highest    with -D RANGE: highest inside value
 *             ni nj nk   voxels of the whole volume
 *             border     layers of outside around the volume, 0 or 1
 *             first_slice          slice of the volume that `voxels` begins with
 *             first_sample_slice   slice of the sample grid that the mask begins with
 *             gk         slices of the mask
 *             words      words a row, ceil((ni + 2 border) / 32)
 * Launch      global = gj * gk rounded up by the host, any local: one item a row, so that dividing for j and k
 *             costs little
 * Guarantees  every word of the mask and every extent is written; bits beyond the row are 0 */
__kernel void classify_samples(
    __global const VOXEL *restrict voxels, __global uint *restrict mask, __global ushort2 *restrict row_extents,
    const VOXEL level,
    const int ni, const int nj, const int nk, const int border, const int first_slice, const int first_sample_slice,
    const uint gk, const int words HIGHEST_PARAMETER)
{
    const uint gj = nj + 2 * border;
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    __global uint *row_mask = mask + (size_t)row * words;
    const int j = (int)(row % gj) - border;
    const int k = (int)(row / gj) + first_sample_slice - border;
    if (j < 0 || j >= nj || k < 0 || k >= nk) {
        for (int w = 0; w < words; ++w)
            row_mask[w] = border_bits(w, ni, border, 0);
        row_extents[row] = (ushort2)(0, BORDER_IS_INSIDE ? (ushort)words : 0);
        return;
    }
    const inside_bounds bounds = BOUNDS;
    __global const VOXEL *row_voxels = voxels + voxel_index(0, j, k - first_slice, ni, nj);
    word_extent set = {words, 0};
    int w = 0;
    uint before = 0; /* the last voxel of the word before, which a border moves into the next one */
    for (; LANES == 1 && ni % 8 == 0 && w < ni / 32; ++w) {
        const uint voxel_bits = classify_vectors((__global const VOXEL8 *)(row_voxels + 32 * w), bounds);
        const uint bits = voxel_bits << border | before | border_bits(w, ni, border, 1);
        before = voxel_bits >> 31 & (uint)border;
        store_word(row_mask, w, bits, &set);
    }
    for (; w < words; ++w) {
        const uint bits = classify_word(row_voxels, 32 * w - border, ni, bounds) | border_bits(w, ni, border, 1);
        store_word(row_mask, w, bits, &set);
    }
    row_extents[row] = (ushort2)((ushort)min(set.begin, set.end), (ushort)set.end);
}

#if !defined(RANGE) && !defined(BORDER_INSIDE)
/* classify_samples where the ranges of the volume's bricks are known: reads the voxels of mixed words alone.
 *
 * Parameters  word_states   in   (bk, bj, words) of the whole volume, see cl/resident/bricks.cl
 *             word_extents  in   (bk, bj)
 *             voxels        in   the whole volume
 *             all others    as classify_samples */
__kernel void classify_bricks(
    __global const uchar *restrict word_states, __global const ushort2 *restrict word_extents,
    __global const VOXEL *restrict voxels, __global uint *restrict mask, __global ushort2 *restrict row_extents,
    const VOXEL level,
    const int ni, const int nj, const int nk, const int border, const int words)
{
    const uint gj = nj + 2 * border, gk = nk + 2 * border;
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    __global uint *row_mask = mask + (size_t)row * words;
    const int j = (int)(row % gj) - border;
    const int k = (int)(row / gj) - border;
    const int in_volume = j >= 0 && j < nj && k >= 0 && k < nk;
    const size_t brick_row = in_volume ? (size_t)(k / BRICK) * ((nj + BRICK - 1) / BRICK) + j / BRICK : 0;
    const ushort2 extent = in_volume ? word_extents[brick_row] : (ushort2)(0, 0);
    for (int w = 0; w < extent.x; ++w)
        row_mask[w] = 0;
    for (int w = extent.y; w < words; ++w)
        row_mask[w] = 0;
    __global const VOXEL *row_voxels = voxels + (in_volume ? voxel_index(0, j, k, ni, nj) : 0);
    __global const uchar *row_states = word_states + brick_row * words;
    const inside_bounds bounds = {level};
    word_extent set = {words, 0};
    for (int w = extent.x; w < extent.y; ++w) {
        const int first = 32 * w - border;
        uint bits = 0;
        if (row_states[w] == BRICK_MIXED) {
            bits = classify_word(row_voxels, first, ni, bounds);
            PREFETCH(row_voxels + 2 * ni + first);
        } else if (row_states[w] == BRICK_INSIDE)
            bits = (uint)(low_bits(min(32, ni - first)) & ~low_bits(max(0, -first)));
        store_word(row_mask, w, bits, &set);
    }
    row_extents[row] = (ushort2)((ushort)min(set.begin, set.end), (ushort)set.end);
}
#endif
