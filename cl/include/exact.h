/* Stands before every kernel file: what all compilers have to compute with the same bits.
 * A compiler that may contract rounds a * b + c once, where it likes to (NVIDIA's does in most places), and drivers differ
 * in the order in which dot() adds. */
#ifndef CLRECON_EXACT_H
#define CLRECON_EXACT_H

#pragma OPENCL FP_CONTRACT OFF

static inline float dot2(const float2 a, const float2 b) { return a.x * b.x + a.y * b.y; }

static inline float dot3(const float3 a, const float3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

static inline float dot4(const float4 a, const float4 b) { return (a.x * b.x + a.y * b.y) + (a.z * b.z + a.w * b.w); }

static inline float3 cross3(const float3 a, const float3 b)
{
    return (float3)(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

#endif
