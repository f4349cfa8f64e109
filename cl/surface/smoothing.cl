/* Low pass over a surface: the steps of its vertices by a polynomial of the mean of neighbours.
 *
 * Reference: G. Taubin, T. Zhang, G. Golub, "Optimal surface smoothing as filter design", 1996 (the polynomial);
 * C. W. Clenshaw, "A note on the summation of Chebyshev series", 1955 (its sum).
 *
 *           .----.           bend of a vertex: the mean of its neighbours, less itself.  Places are not filtered, but
 *          / \  / \          bends, which are short vectors: their rounding is that of float32 beside a step, wherever
 *         .---\/---.         the surface lies, and a surface without bends stays as it is.
 *          \  /\  /
 *           .----.
 *
 * Passes
 *   1. measure_bends   once
 *   2. filter_bends    once for each term of the polynomial, from the last one on, two arrays in turn */

/* Parameters  places   in   (count,) mm, the last component 0
 *             begin    in   (count + 1,) where the corners at each vertex begin in `after` and `before`
 *             after, before   in   vertices: the next and the previous corner of each triangle at the vertex
 *             weights  in   (count,) 1 / number of corners; 0: the vertex does not move
 *             bends    out  (count,) mm, the mean of the next corners less the vertex
 *             normals  out  (count,) mm2, twice the sum of the areas around the vertex, as vectors
 *             count
 * Launch      global = count, rounded up by the host, any local
 * Assumes     all vertices are below count
 * Guarantees  written for every vertex; sums are in the order of corners, so that all devices have the same bits */
__kernel void measure_bends(
    __global const float4 *restrict places, __global const int *restrict begin, __global const uint *restrict after,
    __global const uint *restrict before, __global const float *restrict weights, __global float4 *restrict bends,
    __global float4 *restrict normals, const uint count)
{
    const uint vertex = get_global_id(0);
    if (vertex >= count)
        return;
    const float4 own = places[vertex];
    const int end = begin[vertex + 1u];
    float4 sum = 0.0f;
    float3 normal = 0.0f;
    for (int entry = begin[vertex]; entry < end; ++entry) {
        const float4 next = places[after[entry]] - own, last = places[before[entry]] - own;
        sum += next;
        normal += cross3(next.xyz, last.xyz);
    }
    bends[vertex] = weights[vertex] * sum;
    normals[vertex] = (float4)(normal, 0.0f);
}

/* Parameters  bends    in   (count,) mm, of `measure_bends`
 *             later    in   (count,) mm, the sum from the next term on
 *             begin, after, weights, count   in   as above
 *             sums     in and out   (count,) mm: the sum from the second next term on, then that from this term on
 *             factor   coefficient of this term
 *             share    1; 0.5 for the first term, which is the last one to be added
 * Launch      global = count, rounded up by the host, any local
 * Assumes     as above
 * Guarantees  sums = (factor * bends + share * (later + mean of the neighbours of later)) - sums, for every vertex */
__kernel void filter_bends(
    __global const float4 *restrict bends, __global const float4 *restrict later, __global const int *restrict begin,
    __global const uint *restrict after, __global const float *restrict weights, __global float4 *restrict sums,
    const float factor, const float share, const uint count)
{
    const uint vertex = get_global_id(0);
    if (vertex >= count)
        return;
    const int end = begin[vertex + 1u];
    float4 sum = 0.0f;
    for (int entry = begin[vertex]; entry < end; ++entry)
        sum += later[after[entry]];
    sums[vertex] = (factor * bends[vertex] + share * (later[vertex] + weights[vertex] * sum)) - sums[vertex];
}
