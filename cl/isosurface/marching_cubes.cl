/* Marching cubes on packed bits, with indexed triangles and vertices that neighbouring cells share.
 *
 * References: Lorensen and Cline 1987 (marching cubes); Schroeder, Maynard, Geveci 2015, "Flying Edges" (edges
 * owned by samples, counting before writing); the packing of the inside test to one bit a sample is our own.
 *
 * Passes
 *   1. classify_samples   one bit a sample: inside or not
 *   2. count_rows         per row: vertices, triangles and words with work; per word its place in the row
 *      (exclusive scans of the row counts and compaction of the words with work: cl/compaction)
 *   3. emit_vertices      positions and normals of the vertices of each word with work
 *   4. emit_triangles     vertex numbers of the triangles of each word with work
 *
 * A sample owns the edges towards i + 1, j + 1 and k + 1.  Vertices are numbered by row, then by owner along the
 * row, then by axis: the number of any edge's vertex follows from three popcounts, so vertices are computed once
 * and shared without a hash, an atomic or an index array, and the order never depends on the device. */
#include "include/volume.h"
#include "include/mc_tables.h"
#include "isosurface/mask_rows.h"

/* Bits of 16 comparison results (-1 or 0 each): bit n is lane n. */
static inline uint pack_lanes(short16 lanes)
{
    const ushort16 bits = as_ushort16(lanes)
        & (ushort16)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768);
    const ushort8 by8 = bits.lo | bits.hi;
    const ushort4 by4 = by8.lo | by8.hi;
    const ushort2 by2 = by4.lo | by4.hi;
    return by2.x | by2.y;
}

/* The word of 32 samples that starts at voxel `first` of a row; `first` may lie before it, samples may lie beyond. */
static inline uint classify_word(__global const VOXEL *row, int first, int ni, VOXEL level)
{
    if (ni < 32) {
        uint bits = 0;
        for (int b = max(0, -first); b < min(32, ni - first); ++b)
            bits |= (uint)(row[first + b] >= level) << b;
        return bits;
    }
    /* 32 voxels that lie in the row, shifted to where the word has them. */
    const int begin = clamp(first, 0, ni - 32);
    const uint low = pack_lanes(convert_short16(vload16(0, row + begin) >= level));
    const uint high = pack_lanes(convert_short16(vload16(0, row + begin + 16) >= level));
    const uint bits = low | high << 16;
    if (first < begin)
        return bits << (begin - first);
    return first - begin < 32 ? bits >> (first - begin) : 0;
}

/* Parameters  voxels     in   (nk, nj, ni)
 *             mask       out  (gk, gj, words) bit set where voxel >= level
 *             level      lowest inside value
 *             ni nj nk   voxels
 *             border     layers of outside around the volume, 0 or 1
 *             words      words a row, ceil((ni + 2 border) / 32)
 * Launch      global = gj * gk rounded up by the host, any local: one item a row, so that dividing for j and k
 *             costs little
 * Guarantees  every word of the mask is written; bits beyond the row are 0 */
__kernel void classify_samples(
    __global const VOXEL *restrict voxels, __global uint *restrict mask, const VOXEL level,
    const int ni, const int nj, const int nk, const int border, const int words)
{
    const uint gj = nj + 2 * border, gk = nk + 2 * border;
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    __global uint *row_mask = mask + (size_t)row * words;
    const int j = (int)(row % gj) - border;
    const int k = (int)(row / gj) - border;
    if (j < 0 || j >= nj || k < 0 || k >= nk) {
        for (int w = 0; w < words; ++w)
            row_mask[w] = 0;
        return;
    }
    __global const VOXEL *row_voxels = voxels + voxel_index(0, j, k, ni, nj);
    for (int w = 0; w < words; ++w)
        row_mask[w] = classify_word(row_voxels, 32 * w - border, ni, level);
}

/* Parameters  mask             in   (gk, gj, words)
 *             row_vertices     out  (gk, gj) vertices owned by each row
 *             row_triangles    out  (gk, gj) triangles of the cells of each row
 *             words_with_work  out  (gk, gj, flag_words) bit w of a row: word w owns a vertex or has an active cell
 *             word_vertices    out  (gk, gj, words) vertices of the row before each word
 *             word_triangles   out  (gk, gj, words) triangles of the row before each word
 *             gi gj gk         samples; words a row; flag_words = ceil(words / 32)
 * Launch      global = gj * gk rounded up by the host, any local
 * Assumes     5 (gi + 1) < 65536, so that places in a row fit 16 bits
 * Guarantees  every output is written */
__kernel void count_rows(
    __global const uint *restrict mask,
    __global uint *restrict row_vertices, __global uint *restrict row_triangles,
    __global uint *restrict words_with_work,
    __global ushort *restrict word_vertices, __global ushort *restrict word_triangles,
    const uint gi, const uint gj, const uint gk, const uint words, const uint flag_words)
{
    const uint row = get_global_id(0);
    if (row >= gj * gk)
        return;
    const uint j = row % gj;
    const uint k = row / gj;
    const int has_cells = j + 1 < gj && k + 1 < gk;
    uint vertices = 0, triangles = 0, flags = 0;
    for (uint w = 0; w < words; ++w) {
        word_vertices[(size_t)row * words + w] = (ushort)vertices;
        word_triangles[(size_t)row * words + w] = (ushort)triangles;
        const crossed_edges edges = find_crossed_edges(mask, j, k, w, gi, gj, gk, words);
        const uint own = count_vertices_before(edges, 32);
        uint active = 0;
        if (has_cells) {
            const cell_rows rows = load_cell_rows(mask, j, k, w, gj, words);
            active = find_active_cells(rows, w, gi);
            for (uint rest = active; rest != 0; rest &= rest - 1)
                triangles += (uint)MC_TRIANGLES[cell_case(rows, lowest_bit(rest))] & 15;
        }
        vertices += own;
        flags |= (uint)(own != 0 || active != 0) << (w & 31);
        if ((w & 31) == 31 || w + 1 == words) {
            words_with_work[(size_t)row * flag_words + (w >> 5)] = flags;
            flags = 0;
        }
    }
    row_vertices[row] = vertices;
    row_triangles[row] = triangles;
}

/* Gradient of the field per index step at sample (i, j, k) of the volume: central differences, one-sided at the
 * border of an open volume.  `inner` says that all six neighbours lie in the volume. */
static inline float3 gradient_at(
    __global const VOXEL *voxels, int i, int j, int k, int ni, int nj, int nk, int closed, float outside, int inner)
{
    if (inner) {
        __global const VOXEL *at = voxels + voxel_index(i, j, k, ni, nj);
        const size_t plane = (size_t)ni * (size_t)nj;
        return 0.5f * (float3)(convert_float(at[1]) - convert_float(*(at - 1)),
            convert_float(at[ni]) - convert_float(*(at - ni)),
            convert_float(at[plane]) - convert_float(*(at - plane)));
    }
#define SAMPLE(di, dj, dk) sample_voxel(voxels, i + di, j + dj, k + dk, ni, nj, nk, closed, outside)
    const float3 change = (float3)(SAMPLE(1, 0, 0) - SAMPLE(-1, 0, 0), SAMPLE(0, 1, 0) - SAMPLE(0, -1, 0),
        SAMPLE(0, 0, 1) - SAMPLE(0, 0, -1));
#undef SAMPLE
    const float3 one_sided = (float3)(i == 0 || i == ni - 1, j == 0 || j == nj - 1, k == 0 || k == nk - 1);
    return change * (closed ? (float3)(0.5f) : 0.5f + 0.5f * one_sided);
}

/* Sum of two floats and its exact rounding error (Knuth). */
static inline float3 add_exactly(float3 a, float3 b, float3 *error)
{
    const float3 sum = a + b;
    const float3 part = sum - a;
    *error += (a - (sum - part)) + (b - part);
    return sum;
}

/* Parameters  voxels          in   (nk, nj, ni)
 *             mask            in   (gk, gj, words)
 *             active_words    in   (active,) numbers of the words with work: bits of words_with_work
 *             row_offsets     in   (gk, gj) vertices before each row
 *             word_vertices   in   (gk, gj, words)
 *             slice_frames    in   (gk, 6) float4: position of sample (0, 0, k) in mm (rounded to 12 bits, rest),
 *                                  step to slice k + 1, and the three rows of the matrix that maps gradients per
 *                                  index step to gradients per mm
 *             steps           in   (4,) float4: mm for one step along i (rounded to 12 bits, rest), along j
 *             positions       out  (vertices, 3) mm
 *             normals         out  (vertices, 3) unit, towards lower values
 *             iso_level       where on an edge the surface lies
 *             outside         value beyond the border of a closed volume
 *             value_scale     power of two that takes the values to 1 or below: squares neither over- nor underflow
 *             margin          smallest distance of a vertex from a sample along x, y, z, in steps: some units in the
 *                             last place of the position, so that no triangle collapses when it is rounded
 *             ni nj nk, border, words, flag_words, active   as above
 * Launch      global = active rounded up by the host, any local
 * Guarantees  every position and normal is written once.  Positions are right to one unit in the last place of the
 *             volume's largest coordinate (half a unit up to 4096 samples an axis, where products of a sample number
 *             and a step of 12 bits are exact; sums keep their error) */
__kernel void emit_vertices(
    __global const VOXEL *restrict voxels, __global const uint *restrict mask,
    __global const uint *restrict active_words, __global const uint *restrict row_offsets,
    __global const ushort *restrict word_vertices,
    __global const float4 *restrict slice_frames, __global const float4 *restrict steps,
    __global float *restrict positions, __global float *restrict normals,
    const float iso_level, const float outside, const float value_scale, const float4 margin,
    const int ni, const int nj, const int nk, const int border, const uint words, const uint flag_words,
    const uint active)
{
    if (get_global_id(0) >= active)
        return;
    const uint gi = ni + 2 * border, gj = nj + 2 * border, gk = nk + 2 * border;
    const uint flag = active_words[get_global_id(0)];
    const uint row = flag / (32 * flag_words);
    const uint w = flag % (32 * flag_words);
    const uint j = row % gj, k = row / gj;
    const crossed_edges edges = find_crossed_edges(mask, j, k, w, gi, gj, gk, words);

    __global const float4 *frame = slice_frames + 6 * (size_t)k;
    const float3 k_step = frame[2].xyz;
    const float3 i_step = steps[0].xyz + steps[1].xyz;
    const float3 j_step = steps[2].xyz + steps[3].xyz;
    /* Position of the word's first sample, and what rounding left of it. */
    const float word_i = (float)((int)(32 * w) - border), row_j = (float)((int)j - border);
    float3 base_rest = frame[1].xyz + word_i * steps[1].xyz + row_j * steps[3].xyz;
    float3 base = add_exactly(frame[0].xyz, row_j * steps[2].xyz, &base_rest);
    base = add_exactly(base, word_i * steps[0].xyz, &base_rest);

    const size_t row_stride = ni, slice_stride = (size_t)ni * (size_t)nj;
    const int vj = (int)j - border, vk = (int)k - border;
    const int row_is_inner = vj >= 1 && vj < nj - 2 && vk >= 1 && vk < nk - 2;
    size_t vertex = row_offsets[row] + word_vertices[(size_t)row * words + w];
    for (uint rest = (uint)(edges.x | edges.y | edges.z); rest != 0; rest &= rest - 1) {
        const uint b = lowest_bit(rest);
        const int vi = (int)(32 * w + b) - border;
        const int inner = row_is_inner && vi >= 1 && vi < ni - 2;
        const float3 at_sample = base_rest + (float)b * i_step;
        const size_t here = inner ? voxel_index(vi, vj, vk, ni, nj) : 0;
        const float value = inner ? convert_float(voxels[here]) : sample_voxel(voxels, vi, vj, vk, ni, nj, nk, 1, outside);
        const float3 gradient = gradient_at(voxels, vi, vj, vk, ni, nj, nk, border, outside, inner);
        for (int axis = 0; axis < 3; ++axis) {
            const ulong crossed = axis == 0 ? edges.x : axis == 1 ? edges.y : edges.z;
            if (!(crossed >> b & 1))
                continue;
            const int di = axis == 0, dj = axis == 1, dk = axis == 2;
            const size_t stride = axis == 0 ? 1 : axis == 1 ? row_stride : slice_stride;
            const float next = inner ? convert_float(voxels[here + stride])
                                     : sample_voxel(voxels, vi + di, vj + dj, vk + dk, ni, nj, nk, 1, outside);
            const float3 next_gradient
                = gradient_at(voxels, vi + di, vj + dj, vk + dk, ni, nj, nk, border, outside, inner);
            const float keep = axis == 0 ? margin.x : axis == 1 ? margin.y : margin.z;
            const float t = clamp((iso_level - value) / (next - value), keep, 1.0f - keep);
            const float3 step = axis == 0 ? i_step : axis == 1 ? j_step : k_step;
            vstore3(base + (at_sample + t * step), vertex, positions);

            /* Where the differences cancel, the edge itself says which way is down. */
            float3 slope = value_scale * (gradient + t * (next_gradient - gradient));
            if (dot(slope, slope) == 0.0f)
                slope = (next > value ? 1.0f : -1.0f) * (float3)(di, dj, dk);
            const float3 up = (float3)(
                dot(frame[3].xyz, slope), dot(frame[4].xyz, slope), dot(frame[5].xyz, slope));
            vstore3(-up / sqrt(dot(up, up)), vertex, normals);
            ++vertex;
        }
    }
}

/* Parameters  mask              in   (gk, gj, words)
 *             active_words      in   (active,)
 *             vertex_offsets    in   (gk, gj) vertices before each row
 *             triangle_offsets  in   (gk, gj) triangles before each row
 *             word_vertices     in   (gk, gj, words)
 *             word_triangles    in   (gk, gj, words)
 *             triangles         out  (triangles, 3) vertex numbers, counter-clockwise as seen from lower values
 *             gi gj gk, words, flag_words, active   as above
 *             mirrored          1 when index space is left-handed in mm: the winding is turned round
 * Launch      global = active rounded up by the host, any local
 * Guarantees  every triangle is written once, cell by cell along the rows */
__kernel void emit_triangles(
    __global const uint *restrict mask, __global const uint *restrict active_words,
    __global const uint *restrict vertex_offsets, __global const uint *restrict triangle_offsets,
    __global const ushort *restrict word_vertices, __global const ushort *restrict word_triangles,
    __global uint *restrict triangles,
    const uint gi, const uint gj, const uint gk, const uint words, const uint flag_words, const uint active,
    const int mirrored)
{
    if (get_global_id(0) >= active)
        return;
    const uint flag = active_words[get_global_id(0)];
    const uint row = flag / (32 * flag_words);
    const uint w = flag % (32 * flag_words);
    const uint j = row % gj, k = row / gj;
    if (j + 1 >= gj || k + 1 >= gk)
        return;
    const cell_rows rows = load_cell_rows(mask, j, k, w, gj, words);
    uint rest = find_active_cells(rows, w, gi);
    if (rest == 0)
        return;

    /* Rows of samples around the row of cells, numbered by y + 2 z. */
    crossed_edges edges[4];
    uint first[4];
    for (uint around = 0; around < 4; ++around) {
        const uint rj = j + (around & 1), rk = k + (around >> 1);
        const uint r = row_index(rj, rk, gj);
        edges[around] = find_crossed_edges(mask, rj, rk, w, gi, gj, gk, words);
        first[around] = vertex_offsets[r] + word_vertices[(size_t)r * words + w];
    }

    size_t triangle = (size_t)triangle_offsets[row] + word_triangles[(size_t)row * words + w];
    for (; rest != 0; rest &= rest - 1) {
        const uint b = lowest_bit(rest);
        /* Vertex numbers of the cell's 12 edges; those of edges that are not crossed are never looked up. */
        uint numbers[12];
        for (uint around = 0; around < 4; ++around) {
            const crossed_edges e = edges[around];
            const uint here = first[around] + count_vertices_before(e, b);
            const uint x = e.x >> b & 1, y = e.y >> b & 1, z = e.z >> b & 1;
            const uint next = here + x + y + z;
            const uint next_x = e.x >> (b + 1) & 1, next_y = e.y >> (b + 1) & 1;
            numbers[around] = here;
            if ((around & 1) == 0) { /* y = 0: owns y edges, which are numbered by x + 2 z */
                numbers[4 + around] = here + x;
                numbers[5 + around] = next + next_x;
            }
            if (around < 2) { /* z = 0: owns z edges, which are numbered by x + 2 y */
                numbers[8 + 2 * around] = here + x + y;
                numbers[9 + 2 * around] = next + next_x + next_y;
            }
        }
        ulong packed = MC_TRIANGLES[cell_case(rows, b)];
        const uint count = (uint)packed & 15;
        packed >>= 4;
        for (uint n = 0; n < count; ++n, packed >>= 12) {
            const uint a = numbers[packed & 15], c = numbers[packed >> 8 & 15];
            vstore3((uint3)(mirrored ? c : a, numbers[packed >> 4 & 15], mirrored ? a : c), triangle++, triangles);
        }
    }
}
