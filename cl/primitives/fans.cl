/* Corners around each vertex of a triangle mesh, and whether their triangles form one closed fan.
 *
 * Where they do, each edge at the vertex is in two triangles that run along it in opposite directions, and the surface
 * does not touch itself there: nothing is left to be counted.
 *
 *          b ---- a         corners of v, each with the vertices before and after v:
 *         / \    / \            b a    a f    f e    e d    d c    c b
 *        /   \  /   \       From triangle to triangle, the vertex after v is the one before v in the next triangle.
 *       c --- v ---- f      The fan is closed if that leads through all corners and back, and if each vertex is found
 *        \   /  \   /       once as the one before and once as the one after.
 *         \ /    \ /
 *          d ---- e
 *
 * Passes, after clear_labels of union_find.cl has cleared the heads
 *   1. link_corners   a list of the corners of each vertex
 *   2. follow_fans    its fan, and the first label of union_find.cl
 *
 * Races.  Items of link_corners whose triangles share a vertex write its head, by atomic_xchg() alone: each corner is
 * then in one list, in any order, and follow_fans brings the same whatever the order. */
#define NO_CORNER 0xffffffffu
#define LONGEST_FAN 16

/* Parameters  triangles  in      (m, 3) numbers of vertices
 *             heads      in/out  (n,) NO_CORNER; then a corner of the vertex, 3 * triangle + its place there
 *             links      out     (m, 3) the next corner of the same vertex, NO_CORNER after the last one
 *             m          triangles, at most 2^32 / 3
 * Launch      global = m rounded up by the host, any local
 * Guarantees  every link is written; vertices without triangles keep NO_CORNER */
__kernel void link_corners(
    __global const uint *restrict triangles, __global uint *heads, __global uint *restrict links, const uint m)
{
    const uint triangle = get_global_id(0);
    if (triangle >= m)
        return;
    const uint3 corner = vload3(triangle, triangles);
    const uint first = 3 * triangle;
    const uint a = atomic_xchg(heads + corner.x, first);
    const uint b = atomic_xchg(heads + corner.y, first + 1);
    const uint c = atomic_xchg(heads + corner.z, first + 2);
    vstore3((uint3)(a, b, c), triangle, links);
}

/* The vertices before and after a corner in its triangle. */
static inline uint2 neighbours_of(__global const uint *restrict triangles, const uint corner)
{
    const uint place = corner % 3;
    return (uint2)(triangles[place == 0 ? corner + 2 : corner - 1], triangles[place == 2 ? corner - 2 : corner + 1]);
}

static inline uint8 shift_in(const uint first, const uint8 v) { return (uint8)(first, v.s0123, v.s45, v.s6); }

static inline int sum_of(const int8 v)
{
    const int4 four = v.lo + v.hi;
    return (four.x + four.y) + (four.z + four.w);
}

static inline uint union_of(const uint8 v)
{
    const uint4 four = v.lo | v.hi;
    return (four.x | four.y) | (four.z | four.w);
}

/* Parameters  triangles  in   (m, 3)
 *             heads, links   in   as linked
 *             labels     out  (n,) the smallest vertex in one triangle with the vertex, or its own number; NO_CORNER
 *                             where no triangle uses it
 *             mask       out  (words,) bit b of word w: the triangles of vertex 32 w + b, if it has any, are not one
 *                             closed fan of 3 to LONGEST_FAN
 *             n          vertices
 * Launch      global = words = ceil(n / 32) rounded up by the host, any local
 * Guarantees  every label and word is written */
__kernel void follow_fans(
    __global const uint *restrict triangles, __global const uint *restrict heads, __global const uint *restrict links,
    __global uint *restrict labels, __global uint *restrict mask, const uint n)
{
    const uint word = get_global_id(0);
    if (word > (n - 1) / 32)
        return;
    const uint begin = 32 * word;
    const uint count = min(32u, n - begin);
    uint bits = 0;
    for (uint bit = 0; bit < count; ++bit) {
        uint corner = heads[begin + bit];
        if (corner == NO_CORNER) {
            labels[begin + bit] = NO_CORNER;
            continue;
        }
        uint8 before = NO_CORNER, after = NO_CORNER; /* of the last eight corners */
        uint8 more_before = NO_CORNER, more_after = NO_CORNER;
        uint label = begin + bit, corners = 0, start = 0;
        for (; corner != NO_CORNER; corner = links[corner]) {
            const uint2 ends = neighbours_of(triangles, corner);
            label = min(label, min(ends.x, ends.y));
            more_before = shift_in(before.s7, more_before);
            more_after = shift_in(after.s7, more_after);
            before = shift_in(ends.x, before);
            after = shift_in(ends.y, after);
            start = ends.y;
            ++corners;
        }
        labels[begin + bit] = label;

        uint turned = 0, vertex = start;
        int once = corners <= LONGEST_FAN;
        while (once) {
            const int8 is_before = before == vertex, is_more = more_before == vertex; /* -1 for each */
            const int8 is_after = (after == vertex) + (more_after == vertex);
            once = sum_of(LONGEST_FAN * 2 * (is_before + is_more) + is_after) == -(LONGEST_FAN * 2 + 1);
            vertex = union_of((after & as_uint8(is_before)) | (more_after & as_uint8(is_more)));
            ++turned;
            if (vertex == start || turned > LONGEST_FAN)
                break;
        }
        bits |= (uint)!(once && turned == corners && turned > 2) << bit;
    }
    mask[word] = bits;
}
