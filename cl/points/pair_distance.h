/* Whether two points lie within a distance: the decision of exact arithmetic on float32 coordinates.
 *
 * float32 finds the square of a distance to 3e-7 of it.  Where it is within 1e-6 of the square of the limit, sums of two
 * floats decide, which have 48 bits (Dekker 1971, "A floating-point technique for extending the available precision").
 *
 *      bounds.x          limit^2            bounds.y
 *   -----|------------------|------------------|-------> square of the distance in float32
 *   near |     sums of two floats decide       | not near */
#ifndef CLRECON_POINTS_PAIR_DISTANCE_H
#define CLRECON_POINTS_PAIR_DISTANCE_H

#include "include/lanes.h"

/* x + y is the exact difference a - b. */
static inline float2 exact_difference(const float a, const float b)
{
    const float rounded = a - b;
    const float part = rounded - a;
    return (float2)(rounded, (a - (rounded - part)) - (b + part));
}

/* x + y is the square of the sum d.x + d.y, to 48 bits. */
static inline float2 near_square(const float2 d)
{
    const float square = d.x * d.x;
    return (float2)(square, fma(d.x, d.x, -square) + (2.0f * d.x * d.y + d.y * d.y));
}

/* x + y is the sum of both, to 48 bits. */
static inline float2 near_sum(const float2 a, const float2 b)
{
    const float sum = a.x + b.x;
    const float part = sum - a.x;
    return (float2)(sum, (a.x - (sum - part)) + (b.x - part) + (a.y + b.y));
}

/* 1 where the square of the distance is at most bounds.z + bounds.w; for distances near that. */
static inline int is_near_exactly(const float3 a, const float3 b, const float4 bounds)
{
    const float2 x = near_square(exact_difference(a.x, b.x)), y = near_square(exact_difference(a.y, b.y)),
                 z = near_square(exact_difference(a.z, b.z));
    const float2 square = near_sum(near_sum(x, y), z);
    return (square.x - bounds.z) + (square.y - bounds.w) <= 0.0f;
}

/* Points b, LANES of them, that are near to point a: -1 in a vector, 1 in a scalar.  No point is near to NaN. */
static inline ints are_near(const float3 a, const floats bx, const floats by, const floats bz, const float4 bounds)
{
    const floats dx = bx - a.x, dy = by - a.y, dz = bz - a.z;
    const floats square = dx * dx + dy * dy + dz * dz;
    ints near = square <= bounds.x;
    const ints doubtful = (square <= bounds.y) & (square > bounds.x);
    if (ANY_LANE(doubtful)) {
#if LANES == 8
        float x[8], y[8], z[8];
        int sure[8], doubt[8];
        vstore8(bx, 0, x);
        vstore8(by, 0, y);
        vstore8(bz, 0, z);
        vstore8(near, 0, sure);
        vstore8(doubtful, 0, doubt);
        for (int lane = 0; lane < 8; ++lane)
            if (doubt[lane])
                sure[lane] = -is_near_exactly(a, (float3)(x[lane], y[lane], z[lane]), bounds);
        near = vload8(0, sure);
#else
        near = is_near_exactly(a, (float3)(bx, by, bz), bounds);
#endif
    }
    return near;
}

/* Lanes of a range that ends before `end`, the first of which is `at`: -1 in a vector, 1 in a scalar. */
static inline ints lanes_before(const uint at, const uint end)
{
#if LANES == 8
    return (int8)(0, 1, 2, 3, 4, 5, 6, 7) < (int8)((int)min(end - at, 8u));
#else
    return at < end;
#endif
}

static inline uint count_lanes(const ints set)
{
#if LANES == 8
    const int4 half_way = set.lo + set.hi;
    const int2 quarter = half_way.lo + half_way.hi;
    return (uint)-(quarter.x + quarter.y);
#else
    return (uint)set;
#endif
}

#endif
