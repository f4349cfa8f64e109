/* Words of a bit mask, LANES at a time, and counters of bits: 32 counters of 8 bits in 8 planes of a word. */
#ifndef CLRECON_BIT_COUNTERS_H
#define CLRECON_BIT_COUNTERS_H

#include "include/lanes.h"

#if LANES == 8
typedef uint8 word_lanes;
#define ANY_BIT(vector) ANY_LANE((vector) != 0)
#else
typedef uint word_lanes;
#define ANY_BIT(vector) ((vector) != 0)
#endif

/* Words at..at + LANES - 1 of a mask of `total` words; zeros beyond its ends. */
static inline word_lanes load_words(__global const uint *restrict mask, const int at, const int total)
{
#if LANES == 8
    if (at >= 0 && at + LANES <= total)
        return vload8(0, mask + at);
    uint word[8];
    for (int lane = 0; lane < 8; ++lane)
        word[lane] = at + lane >= 0 && at + lane < total ? mask[at + lane] : 0;
    return vload8(0, word);
#else
    return at >= 0 && at < total ? mask[at] : 0;
#endif
}

/* The same bits, `shift` voxels further along i: bit b is voxel 32 at + b + shift. */
static inline word_lanes load_shifted(
    __global const uint *restrict mask, const int at, const int shift, const int total)
{
    const int word = at + (shift >> 5);
    const uint bits = shift & 31;
    const word_lanes low = load_words(mask, word, total);
    if (bits == 0)
        return low;
    return low >> bits | load_words(mask, word + 1, total) << (32 - bits);
}

/* Counters of bits: plane 7 is the highest. */
typedef struct {
    word_lanes p0, p1, p2, p3, p4, p5, p6, p7;
} bit_counters;

#define ADD_TO(plane) \
    { \
        const word_lanes sum = plane ^ carry; \
        carry &= plane; \
        plane = sum; \
    }

/* Add one to the counters whose bit is set; returns those that overflow. */
static inline word_lanes add_bits(bit_counters *counters, word_lanes carry, const int planes)
{
    switch (planes) {
    case 8:
        ADD_TO(counters->p0)
    case 7:
        ADD_TO(counters->p1)
    case 6:
        ADD_TO(counters->p2)
    case 5:
        ADD_TO(counters->p3)
    case 4:
        ADD_TO(counters->p4)
    case 3:
        ADD_TO(counters->p5)
    case 2:
        ADD_TO(counters->p6)
    case 1:
        ADD_TO(counters->p7)
    }
    return carry;
}

/* Store the lowest `count` words, or all of them. */
static inline void store_words(const word_lanes words, __global uint *restrict to, const int count)
{
#if LANES == 8
    if (count >= LANES) {
        vstore8(words, 0, to);
        return;
    }
    uint word[8];
    vstore8(words, 0, word);
    for (int lane = 0; lane < count; ++lane)
        to[lane] = word[lane];
#else
    *to = words;
#endif
}

/* Plane `8 - which` of all counters at the beginning. */
#define FIRST_BIT(which) (planes >= which && (start >> (planes - which) & 1) ? ~0u : 0u)

#endif
