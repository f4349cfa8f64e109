/* Simple functions of OpenCL as code that becomes part of the kernels: for PoCL 3.0, where each of them is a call.
 *
 * PoCL 3.0 brings its functions compiled for one processor of each generation, but compiles kernels for the very
 * processor at hand.  LLVM 14 inlines no function across that difference, so min(), popcount() and vload8() in a loop
 * are calls that take longer than their work.  The host puts this header before every kernel file there, and nowhere
 * else (`clrecon.opencl.quirks.first_header`); kernels are written as the standard has it.
 *
 * Each gives the same bits as the function that it replaces, for NaN and both zeros too.  A call with types that are
 * missing here does not compile, on PoCL 3.0 alone: add them. */
#ifndef CLRECON_INLINED_H
#define CLRECON_INLINED_H

#define INLINED static inline __attribute__((always_inline, overloadable))

#define INLINED_FOR_WHOLE_TYPES(make) \
    make(char) make(uchar) make(short) make(ushort) make(int) make(uint) make(long) make(ulong)
#define INLINED_FOR_WIDTHS(make, type) make(type) make(type##2) make(type##3) make(type##4) make(type##8) make(type##16)

/* ---- order ---- */
#define INLINED_ORDER(type) \
    INLINED type inlined_min(const type a, const type b) { return a < b ? a : b; } \
    INLINED type inlined_max(const type a, const type b) { return a > b ? a : b; }
#define INLINED_CLAMP(type) \
    INLINED type inlined_clamp(const type a, const type low, const type high) \
    { \
        return inlined_min(inlined_max(a, low), high); \
    }
#define INLINED_ORDER_OF_ALL(type) INLINED_FOR_WIDTHS(INLINED_ORDER, type)
#define INLINED_CLAMP_ALL(type) INLINED_FOR_WIDTHS(INLINED_CLAMP, type)
INLINED_FOR_WHOLE_TYPES(INLINED_ORDER_OF_ALL)
INLINED_FOR_WHOLE_TYPES(INLINED_CLAMP_ALL)
INLINED_ORDER_OF_ALL(float)

/* The other one where one is NaN. */
#define INLINED_ORDER_OF_NUMBERS(type) \
    INLINED type inlined_fmin(const type a, const type b) { return ((a < b) | (b != b)) ? a : b; } \
    INLINED type inlined_fmax(const type a, const type b) { return ((a > b) | (b != b)) ? a : b; } \
    INLINED type inlined_clamp(const type a, const type low, const type high) \
    { \
        return inlined_fmin(inlined_fmax(a, low), high); \
    }
INLINED_FOR_WIDTHS(INLINED_ORDER_OF_NUMBERS, float)

#undef min
#undef max
#undef clamp
#undef fmin
#undef fmax
#define min(a, b) inlined_min(a, b)
#define max(a, b) inlined_max(a, b)
#define clamp(a, low, high) inlined_clamp(a, low, high)
#define fmin(a, b) inlined_fmin(a, b)
#define fmax(a, b) inlined_fmax(a, b)

/* ---- bits and numbers; most of those of vectors are the driver's ---- */
#define INLINED_SQRT_OF_float2 sqrt
#define INLINED_SQRT_OF_float3 sqrt
#define INLINED_SQRT_OF_float4 sqrt
#ifdef __AVX__
#define INLINED_SQRT_OF_float8 __builtin_ia32_sqrtps256
#else
#define INLINED_SQRT_OF_float8 sqrt
#endif
#define INLINED_SQRT_OF_float16 sqrt
#define INLINED_FMA_OF_float2 fma
#define INLINED_FMA_OF_float3 fma
#define INLINED_FMA_OF_float4 fma
#ifdef __FMA__
#define INLINED_FMA_OF_float8 __builtin_ia32_vfmaddps256
#else
#define INLINED_FMA_OF_float8 fma
#endif
#define INLINED_FMA_OF_float16 fma
#define INLINED_OF_VECTORS(type, whole) \
    INLINED whole inlined_popcount(const whole bits) { return popcount(bits); } \
    INLINED whole inlined_isnan(const type a) { return isnan(a); } \
    INLINED type inlined_fabs(const type a) { return as_##type(as_##whole(a) & 0x7fffffff); } \
    INLINED type inlined_sqrt(const type a) { return INLINED_SQRT_OF_##type(a); } \
    INLINED type inlined_floor(const type a) { return floor(a); } \
    INLINED type inlined_ceil(const type a) { return ceil(a); } \
    INLINED type inlined_fma(const type a, const type b, const type c) { return INLINED_FMA_OF_##type(a, b, c); }
INLINED_OF_VECTORS(float2, int2)
INLINED_OF_VECTORS(float3, int3)
INLINED_OF_VECTORS(float4, int4)
INLINED_OF_VECTORS(float8, int8)
INLINED_OF_VECTORS(float16, int16)

INLINED uint inlined_popcount(const uint bits) { return (uint)__builtin_popcount(bits); }
INLINED int inlined_popcount(const int bits) { return __builtin_popcount((uint)bits); }
INLINED ulong inlined_popcount(const ulong bits) { return (ulong)__builtin_popcountl(bits); }
INLINED int inlined_isnan(const float a) { return a != a; }
INLINED float inlined_fabs(const float a) { return __builtin_fabsf(a); }
INLINED float inlined_sqrt(const float a) { return __builtin_sqrtf(a); }
#ifdef __FMA__
INLINED float inlined_fma(const float a, const float b, const float c) { return __builtin_fmaf(a, b, c); }
#else
INLINED float inlined_fma(const float a, const float b, const float c) { return fma(a, b, c); }
#endif
#ifdef __SSE4_1__
INLINED float inlined_floor(const float a) { return __builtin_floorf(a); }
INLINED float inlined_ceil(const float a) { return __builtin_ceilf(a); }
#else
INLINED float inlined_floor(const float a) { return floor(a); }
INLINED float inlined_ceil(const float a) { return ceil(a); }
#endif
#undef popcount
#undef isnan
#undef fabs
#undef sqrt
#undef fma
#undef floor
#undef ceil
#define popcount(bits) inlined_popcount(bits)
#define isnan(a) inlined_isnan(a)
#define fabs(a) inlined_fabs(a)
#define sqrt(a) inlined_sqrt(a)
#define fma(a, b, c) inlined_fma(a, b, c)
#define floor(a) inlined_floor(a)
#define ceil(a) inlined_ceil(a)

/* ---- conversions of vectors ---- */
#undef convert_float2
#undef convert_float3
#undef convert_float4
#undef convert_float8
#undef convert_int2
#undef convert_int3
#undef convert_int4
#undef convert_int8
#undef convert_char16
#undef convert_short8
#undef convert_short16
#undef convert_ushort16
#define convert_float2(a) __builtin_convertvector(a, float2)
#define convert_float3(a) __builtin_convertvector(a, float3)
#define convert_float4(a) __builtin_convertvector(a, float4)
#define convert_float8(a) __builtin_convertvector(a, float8)
#define convert_int2(a) __builtin_convertvector(a, int2)
#define convert_int3(a) __builtin_convertvector(a, int3)
#define convert_int4(a) __builtin_convertvector(a, int4)
#define convert_int8(a) __builtin_convertvector(a, int8)
#define convert_char16(a) __builtin_convertvector(a, char16)
#define convert_short8(a) __builtin_convertvector(a, short8)
#define convert_short16(a) __builtin_convertvector(a, short16)
#define convert_ushort16(a) __builtin_convertvector(a, ushort16)

/* ---- vectors in memory ---- */
#define INLINED_LOOSE(type, n) typedef type##n inlined_##type##n __attribute__((aligned(sizeof(type))));
#define INLINED_ALL_LOOSE(type) \
    INLINED_LOOSE(type, 2) INLINED_LOOSE(type, 4) INLINED_LOOSE(type, 8) INLINED_LOOSE(type, 16)
INLINED_FOR_WHOLE_TYPES(INLINED_ALL_LOOSE)
INLINED_ALL_LOOSE(float)

#define INLINED_LOAD(space, type, n) \
    INLINED type##n inlined_vload##n(const size_t at, const space type *from) \
    { \
        return *(const space inlined_##type##n *)(from + n * at); \
    }
#define INLINED_STORE(space, type, n) \
    INLINED void inlined_vstore##n(const type##n vector, const size_t at, space type *to) \
    { \
        *(space inlined_##type##n *)(to + n * at) = vector; \
    }
#define INLINED_LOADS(space, type) \
    INLINED_LOAD(space, type, 2) INLINED_LOAD(space, type, 4) \
    INLINED_LOAD(space, type, 8) INLINED_LOAD(space, type, 16) \
    INLINED type##3 inlined_vload3(const size_t at, const space type *from) \
    { \
        return (type##3)(from[3 * at], from[3 * at + 1], from[3 * at + 2]); \
    }
#define INLINED_STORES(space, type) \
    INLINED_STORE(space, type, 2) INLINED_STORE(space, type, 4) \
    INLINED_STORE(space, type, 8) INLINED_STORE(space, type, 16) \
    INLINED void inlined_vstore3(const type##3 vector, const size_t at, space type *to) \
    { \
        to[3 * at] = vector.x; \
        to[3 * at + 1] = vector.y; \
        to[3 * at + 2] = vector.z; \
    }
#define INLINED_MEMORY(type) \
    INLINED_LOADS(__global, type) INLINED_LOADS(__local, type) \
    INLINED_LOADS(__private, type) INLINED_LOADS(__constant, type) \
    INLINED_STORES(__global, type) INLINED_STORES(__local, type) INLINED_STORES(__private, type)
INLINED_FOR_WHOLE_TYPES(INLINED_MEMORY)
INLINED_MEMORY(float)

#undef vload2
#undef vload3
#undef vload4
#undef vload8
#undef vload16
#undef vstore2
#undef vstore3
#undef vstore4
#undef vstore8
#undef vstore16
#define vload2(at, from) inlined_vload2(at, from)
#define vload3(at, from) inlined_vload3(at, from)
#define vload4(at, from) inlined_vload4(at, from)
#define vload8(at, from) inlined_vload8(at, from)
#define vload16(at, from) inlined_vload16(at, from)
#define vstore2(vector, at, to) inlined_vstore2(vector, at, to)
#define vstore3(vector, at, to) inlined_vstore3(vector, at, to)
#define vstore4(vector, at, to) inlined_vstore4(vector, at, to)
#define vstore8(vector, at, to) inlined_vstore8(vector, at, to)
#define vstore16(vector, at, to) inlined_vstore16(vector, at, to)

#endif
