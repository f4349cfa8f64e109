/* The decisions of the trilinear field inside a cell: they give the row of trilinear_tables.h with its triangles.
 *
 * All decisions use whole numbers, so that every device and both cells of a face decide alike.
 * Heights of the corners above the iso level are rounded to float once and scaled by a power of two to whole numbers:
 * to 30 bits for a face, by the largest of its four corners; to 18 bits for the interior, by the largest of the
 * eight.  For voxels of 8 and 16 bits at an iso level between integers this is exact.  Whether a corner is inside is
 * told by its bit in the case, never by its height.
 *
 * Corners and edges are numbered as in surface/marching_cubes.cl.  Face 2 axis is the lower one across an axis, face
 * 2 axis + 1 the upper one.  The two ways of an ambiguous face, whose inside corners (*) lie on a diagonal:
 *
 *      d---/----c*         d----\---c*       u and v are the axes after the face's own, in turn: b lies along u
 *      |  /     |          |     \  |        from a, and d along v
 *      | /      |          |      \ |
 *      |/       |          |       \|
 *      /        /          \        \
 *      |       /|          |\       |
 *      |      / |          | \      |
 *      a*----/--b          a*-\-----b
 *      joined: a c > b d   apart             in sizes of the corners' heights
 *
 * References: Nielson and Hamann 1991 (faces); Chernyaev 1995 (interiors); Grosso 2016 (the waist of a tunnel).
 * Derivation and twin: clrecon/proof/surface/trilinear_table.py and trilinear.py. */
#ifndef CLRECON_TRILINEAR_CELL_H
#define CLRECON_TRILINEAR_CELL_H

#include "include/volume.h"
#include "surface/picks.h"
#include "surface/trilinear_tables.h"

#define FACE_BITS 30
#define CELL_BITS 18

/* Biased exponent of a float; 1 for 0 and denormal numbers. */
static inline uint find_exponent(float height)
{
    return max(as_uint(height) >> 23 & 255, 1u);
}

/* Size of a height as a whole number below 2^bits, where `largest` is the greatest exponent of those beside it;
 * rounded towards 0. */
static inline ulong scale_height(float height, uint largest, uint bits)
{
    const uint word = as_uint(height) & 0x7fffffff;
    const ulong mantissa = (word & 0x7fffff) | (word >> 23 != 0 ? 0x800000 : 0);
    return mantissa << 32 >> min(56 - bits + largest - find_exponent(height), 63u);
}

/* Heights of the corners of cell (i, j, k) of the volume; i, j, k may be -1. */
static inline float8 load_heights(const volume_part *volume, int i, int j, int k, float iso_level)
{
#define SAMPLE(x, y, z) convert_float(sample_volume(volume, i + x, j + y, k + z))
    const float8 samples = (float8)(SAMPLE(0, 0, 0), SAMPLE(1, 0, 0), SAMPLE(0, 1, 0), SAMPLE(1, 1, 0),
        SAMPLE(0, 0, 1), SAMPLE(1, 0, 1), SAMPLE(0, 1, 1), SAMPLE(1, 1, 1));
#undef SAMPLE
    return samples - iso_level;
}

/* Whether face f (2 axis: lower, 2 axis + 1: upper) joins its two diagonal inside corners: the product of their heights
 * is above that of the outside corners. */
static inline int face_joins(uint cell_case, const float8 heights, uint face)
{
    const uint axis = face >> 1, u = 1u << (axis + 1) % 3, v = 1u << (axis + 2) % 3;
    const uint a = (face & 1) << axis, b = a | u, c = a | u | v, d = a | v;
    const int8 of = as_int8(heights);
    const float4 at = as_float4((int4)(pick_8(of, a), pick_8(of, b), pick_8(of, c), pick_8(of, d)));
    const uint largest = max(max(find_exponent(at.x), find_exponent(at.y)), max(find_exponent(at.z), find_exponent(at.w)));
#define SIZE(height) scale_height(height, largest, FACE_BITS)
    const ulong ac = SIZE(at.x) * SIZE(at.z), bd = SIZE(at.y) * SIZE(at.w);
#undef SIZE
    return cell_case >> a & 1 ? ac > bd : bd > ac;
}

/* Heights as whole numbers of CELL_BITS bits with the signs that the case says. */
static inline int8 sign_values(uint cell_case, const float8 heights)
{
    const uint8 exponents = max(as_uint8(heights) >> 23 & 255, (uint8)(1)); /* as find_exponent */
    const uint4 of_halves = max(exponents.lo, exponents.hi);
    const uint largest = max(max(of_halves.x, of_halves.y), max(of_halves.z, of_halves.w));
#define SIZE(n) (int)scale_height(heights.s##n, largest, CELL_BITS)
    const int8 sizes = (int8)(SIZE(0), SIZE(1), SIZE(2), SIZE(3), SIZE(4), SIZE(5), SIZE(6), SIZE(7));
#undef SIZE
    const int8 corners = (int8)(1, 2, 4, 8, 16, 32, 64, 128);
    return ((int)cell_case & corners) != 0 ? sizes : -sizes;
}

/* Q(t) = a t^2 + b t + c of the planes across one axis: the product of the field at two diagonal cell edges along the
 * axis less that at the other two.  a, b < 2^41, c < 2^37; the discriminant has 128 bits. */
typedef struct {
    long a, b, discriminant_high;
    ulong discriminant_low;
} parabola;

/* Lower corner of the n-th edge along an axis, counter-clockwise as seen from above. */
static inline uint column(uint axis, uint n)
{
    const uint u = 1u << (axis + 1) % 3, v = 1u << (axis + 2) % 3;
    return (n == 1 || n == 2 ? u : 0) | (n >= 2 ? v : 0);
}

static inline void find_parabola(parabola *q, const int8 values, uint axis)
{
    long low[4], rise[4];
    for (uint n = 0; n < 4; ++n) {
        const uint corner = column(axis, n);
        low[n] = pick_8(values, corner);
        rise[n] = pick_8(values, corner | 1u << axis) - low[n];
    }
    const long c = low[0] * low[2] - low[1] * low[3];
    q->a = rise[0] * rise[2] - rise[1] * rise[3];
    q->b = low[0] * rise[2] + low[2] * rise[0] - low[1] * rise[3] - low[3] * rise[1];
    const ulong square = (ulong)(q->b * q->b), product = (ulong)(4 * q->a * c);
    q->discriminant_low = square - product;
    q->discriminant_high = mul_hi(q->b, q->b) - mul_hi(4 * q->a, c) - (square < product);
}

/* Code of the tunnel that the cell has if its faces allow one, -1 without: signs alternate around the plane at the
 * vertex of the parabola, and it has two roots. */
static inline int find_tunnel(const int8 values)
{
    parabola q;
    find_parabola(&q, values, 2);
    if (q.a == 0 || q.discriminant_high < 0 || (q.discriminant_high == 0 && q.discriminant_low == 0))
        return -1;
    /* The vertex is at top / bottom. */
    const long top = q.a > 0 ? -q.b : q.b, bottom = 2 * (long)abs(q.a);
    if (top <= 0 || top >= bottom)
        return -1;
    int signs[4];
    for (uint n = 0; n < 4; ++n) {
        const long low = pick_4(values.lo, column(2, n)), high = pick_4(values.hi, column(2, n));
        const long there = low * bottom + (high - low) * top;
        signs[n] = (there > 0) - (there < 0);
    }
    if (signs[0] == 0 || signs[2] != signs[0] || signs[1] != -signs[0] || signs[3] != -signs[0])
        return -1;
    const int inside = (signs[0] > 0) == (q.a < 0);
    int diagonal = q.a > 0 ? 4 : 0;
    for (uint axis = 0; axis < 2; ++axis) {
        find_parabola(&q, values, axis);
        diagonal |= (q.a > 0) << axis;
    }
    return inside + 2 * min(diagonal, 7 - diagonal);
}

/* Entry of TRILINEAR_ROWS of a cell whose case has a choice. */
static inline uint choose_row(uint cell_case, const float8 heights)
{
    const uint entry = TRILINEAR_CASES[cell_case];
    uint state = entry & 0xffff, bit = 1;
    for (uint face = 0; face < 6; ++face) {
        if (entry >> (16 + face) & 1) {
            state += face_joins(cell_case, heights, face) ? bit : 0;
            bit <<= 1;
        }
    }
    const uint row = TRILINEAR_STATES[state] & 0xffff, tunnels = TRILINEAR_STATES[state] >> 16;
    if (tunnels == 0)
        return TRILINEAR_ROWS[row];
    const int code = find_tunnel(sign_values(cell_case, heights));
    return TRILINEAR_ROWS[code < 0 ? row : row + (tunnels >> (2 * code) & 3)];
}

static inline uint row_triangles_of(uint row)
{
    return row >> 16 & 31;
}

static inline uint row_vertices_of(uint row)
{
    return row >> 21 & 7;
}

#endif
