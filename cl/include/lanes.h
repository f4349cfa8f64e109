/* Vectors of LANES floats or ints, under names that do not depend on LANES.
 *
 * CPU drivers do not reliably make vector code of work-items that branch, so hot loops are written for LANES values at
 * once; on a GPU, where a work-item is a lane already, LANES is 1.  The host chooses (-D LANES=8).  Files that define
 * TAKES_WIDE_LANES first have 16 instead where the processor has AVX-512 and the driver HAS_WIDE_LANES. */
#ifndef CLRECON_LANES_H
#define CLRECON_LANES_H

#ifndef LANES
#define LANES 1
#endif

#if LANES == 8 && defined(TAKES_WIDE_LANES) && HAS_WIDE_LANES && defined(__AVX512F__)
#undef LANES
#define LANES 16
#endif

#if LANES >= 8
static inline int any_lane(const int8 condition)
{
#ifdef __AVX__
    return __builtin_ia32_movmskps256(as_float8(condition)) != 0;
#else
    const int4 half_way = condition.lo | condition.hi;
    const int2 quarter = half_way.lo | half_way.hi;
    return (quarter.x | quarter.y) != 0;
#endif
}
#endif

#if LANES == 16
typedef float16 floats;
typedef int16 ints;
#define to_floats convert_float16
#define to_ints convert_int16
#define as_floats as_float16
#define as_ints as_int16
#define load_lanes(pointer) vload16(0, pointer)
#define store_lanes(vector, pointer) vstore16(vector, 0, pointer)
#define ANY_LANE(condition) any_lane((condition).lo | (condition).hi)
#elif LANES == 8
typedef float8 floats;
typedef int8 ints;
#define to_floats convert_float8
#define to_ints convert_int8
#define as_floats as_float8
#define as_ints as_int8
#define load_lanes(pointer) vload8(0, pointer)
#define store_lanes(vector, pointer) vstore8(vector, 0, pointer)
#define LANE_NUMBERS ((floats)(0.0f, 1.0f, 2.0f, 3.0f, 4.0f, 5.0f, 6.0f, 7.0f))
#define FIRST_LANE(vector) ((vector).s0)
#define ANY_LANE(condition) any_lane(condition)
#define LEAST_LANE(vector) least_lane(vector)
static inline float least_lane(const float8 v)
{
    const float4 half_way = v.lo < v.hi ? v.lo : v.hi;
    const float2 quarter = half_way.lo < half_way.hi ? half_way.lo : half_way.hi;
    return quarter.x < quarter.y ? quarter.x : quarter.y;
}
/* Entries of a table, as the elements of a vector literal.  That they are volatile keeps compilers from making a gather
 * instruction of them, which takes longer than single loads. */
#define GATHER(type, table, at) \
    ENTRY(type, table, (at).s0), ENTRY(type, table, (at).s1), ENTRY(type, table, (at).s2), \
        ENTRY(type, table, (at).s3), ENTRY(type, table, (at).s4), ENTRY(type, table, (at).s5), \
        ENTRY(type, table, (at).s6), ENTRY(type, table, (at).s7)
#define ENTRY(type, table, at) (((volatile __global const type *)(table))[at])
#elif LANES == 1
typedef float floats;
typedef int ints;
#define to_floats convert_float
#define to_ints convert_int
#define as_floats as_float
#define as_ints as_int
#define load_lanes(pointer) (*(pointer))
#define store_lanes(vector, pointer) (*(pointer) = (vector))
#define LANE_NUMBERS 0.0f
#define FIRST_LANE(vector) (vector)
#define ANY_LANE(condition) (condition)
#define LEAST_LANE(vector) (vector)
#define GATHER(type, table, at) (table)[at]
#else
#error "LANES is 1 or 8"
#endif

/* Lanes of `yes` where the condition holds, of `no` elsewhere.  OpenCL's select() takes true to be -1 in a vector
 * and 1 in a scalar; ?: takes both. */
#define choose(condition, yes, no) ((condition) ? (yes) : (no))

/* Some CPU drivers call a function for every min() and max() of vectors. */
static inline floats lesser(const floats a, const floats b) { return choose(a < b, a, b); }
static inline floats greater(const floats a, const floats b) { return choose(a > b, a, b); }
static inline ints lesser_int(const ints a, const ints b) { return choose(a < b, a, b); }
static inline ints greater_int(const ints a, const ints b) { return choose(a > b, a, b); }

/* Least whole number that is not less; |x| < 2^31. */
static inline floats round_up(const floats x)
{
    const floats whole = to_floats(to_ints(x));
    return choose(whole < x, whole + 1.0f, whole);
}

#endif
