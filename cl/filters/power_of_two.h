/* Powers of two of LANES exponents at once, and products that are added with one rounding. */
#ifndef CLRECON_POWER_OF_TWO_H
#define CLRECON_POWER_OF_TWO_H

#include "include/lanes.h"

#define TO_WHOLE 12582912.0f /* 1.5 * 2^23: what is added to a small number loses its fraction */

#if LANES == 8 && defined(__SSE__) && !defined(__FMA__)
#define fused(a, b, c) ((a) * (b) + (c)) /* there fma() is a long function */
#else
#define fused(a, b, c) fma(a, b, c)
#endif

/* 2^e to a relative error of 4e-6, -120 <= e <= 0: the polynomial is that of least largest error on [-1/2, 1/2]. */
static inline floats power_of_two(const floats e)
{
    const floats shifted = e + TO_WHOLE;
    const floats f = e - (shifted - TO_WHOLE);
    floats power = fused((floats)(0.0095701f), f, (floats)(0.0559176f));
    power = fused(power, f, (floats)(0.2402478f));
    power = fused(power, f, (floats)(0.6931201f));
    power = fused(power, f, (floats)(0.9999993f));
    return as_floats(as_ints(power) + (as_ints(shifted) << 23));
}

#endif
