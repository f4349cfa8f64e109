/* A window on a row of 16-bit voxels: LANES neighbouring places read it with one load and one shuffle, in place of a
 * load for each lane.
 *
 * OpenCL's shuffle() goes through memory on CPU drivers, so this uses clang's builtins for x86 CPUs with AVX2 or
 * AVX-512.  Other compilers and CPUs have no windows (HAS_WINDOWS 0), and every lane loads its own voxels. */
#ifndef CLRECON_WINDOW_H
#define CLRECON_WINDOW_H

#include "include/lanes.h"

#ifndef VOXEL_IS_SHORT
#define VOXEL_IS_SHORT 0 /* VOXEL is short: two of them are one int */
#endif

#define WINDOW 16 /* voxels that are seen */

#if LANES == 8 && VOXEL_IS_SHORT && defined(__AVX2__) && !defined(NO_WINDOWS)
#define HAS_WINDOWS 1

#define SHARES 16384.0f /* fixed point of weights: both of a pair are 16-bit numbers */

#if defined(__AVX512BW__) && defined(__AVX512VL__)
typedef short16 choice;
typedef short16 row_piece __attribute__((aligned(2)));

/* Which pairs of neighbours lanes take: voxels `at` and at + 1 of the window, 0 <= at < WINDOW - 1. */
static inline choice choose_pairs(const int8 at)
{
    return as_short16((at << 16) + at + 0x10000);
}

static inline choice next_pairs(const choice from, const int steps)
{
    return from + (short)steps;
}

static inline short16 take_pairs(__global const short *row, const choice from)
{
    return __builtin_ia32_permvarhi256(*(__global const row_piece *)row, from);
}
#else
typedef char choice __attribute__((ext_vector_type(32))); /* of bytes */
typedef short8 row_piece __attribute__((aligned(2)));

static inline choice choose_pairs(const int8 at)
{
    return __builtin_astype(at * 0x02020202 + 0x03020100, choice);
}

static inline choice next_pairs(const choice from, const int steps)
{
    return from + (char)(2 * steps);
}

static inline short16 take_pairs(__global const short *row, const choice from)
{
    const row_piece low = *(__global const row_piece *)row, high = *(__global const row_piece *)(row + 8);
    /* A byte whose highest bit is set takes nothing. */
    const choice first = __builtin_ia32_pshufb256(
        __builtin_astype((short16)(low, low), choice), from + (choice)(0x70));
    const choice second = __builtin_ia32_pshufb256(
        __builtin_astype((short16)(high, high), choice), from - (choice)(0x10));
    return __builtin_astype(first | second, short16);
}
#endif

/* Ask for a voxel's cache line that will be needed soon.  Address spaces are one on a CPU. */
static inline void fetch_early(__global const short *voxel)
{
    __builtin_prefetch((const void *)(size_t)voxel, 0, 3);
}

/* Weights of pairs for places `part` of the way from the first to the second, 0 <= part < 1. */
static inline short16 weigh_pairs(const float8 part)
{
    const int8 second = convert_int8(part * SHARES + 0.5f);
    return as_short16((second << 16) - second + (int)SHARES);
}

/* SHARES times the values between the voxels of pairs. */
static inline int8 mix_pairs(const short16 pairs, const short16 weights)
{
    return __builtin_ia32_pmaddwd256(pairs, weights);
}

#else
#define HAS_WINDOWS 0
#endif

#endif
