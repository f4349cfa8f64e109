/* One of several values by a number that is known at run time alone.
 *
 * A GPU has no registers with numbers of run time: an array with such an index lies in its memory, and compilers make
 * such an index of branches too.  These choose between halves of a vector. */
#ifndef CLRECON_PICKS_H
#define CLRECON_PICKS_H

#define PICK_3(a, b, c, n) ((n) == 0 ? (a) : (n) == 1 ? (b) : (c))

static inline int pick_4(const int4 of, const uint n)
{
    const int2 two = (int2)(-(int)(n >> 1 & 1)) ? of.hi : of.lo;
    return two.x ^ ((two.x ^ two.y) & -(int)(n & 1));
}

static inline int pick_8(const int8 of, const uint n)
{
    return pick_4((int4)(-(int)(n >> 2 & 1)) ? of.hi : of.lo, n);
}

#endif
