/* Triangles of a surface that may cut another one, for an exact look at these alone.
 *
 * Reference: Moeller 1997, "A fast triangle-triangle intersection test"; the bound of rounding is that of Shewchuk 1997,
 * "Adaptive precision floating-point arithmetic and fast robust geometric predicates", orient3d, doubled.
 *
 * A triangle belongs to the level whose rows are as wide as its box, or up to twice as wide, and to the row (y, z) that
 * holds the lowest corner of its box.  The entries of a row are sorted by that corner's x.  A box that overlaps the box
 * of an item at low, high therefore begins in the rows from low - edge to high, between low.x - edge and high.x:
 *
 *     z   +-------+-------+
 *         |   +---|---+   |     rows of one edge; the item looks at those that its box, longer by an edge towards
 *         +---|---+---|---+     the lower end, touches
 *         |   +---|---+   |
 *         +-------+-------+  y
 *
 * An item looks at the entries behind its own of its level, and at all of the levels with longer triangles: each pair
 * is seen once.  Both of its triangles are marked, by atomic_or(), unless float32 shows that they do not cut each other:
 * signs of volumes that exceed their rounding are those of exact arithmetic. */

/* Share of a volume's sum of absolute terms that its rounding does not reach. */
#define ROUNDING 0x1p-20f
/* What boxes and rows are taken longer by, in edges: more than the rounding of coordinates in float32. */
#define SLACK 1e-3f

#pragma OPENCL FP_CONTRACT OFF

/* Side of the plane through a, b and c on which d lies, 1 or -1; 0 where float32 cannot tell. */
static inline int side_of(const float3 a, const float3 b, const float3 c, const float3 d)
{
    const float3 p = b - a, q = c - a, r = d - a;
    const float3 one = (float3)(q.y * r.z, q.z * r.x, q.x * r.y), other = (float3)(q.z * r.y, q.x * r.z, q.y * r.x);
    const float volume = p.x * (one.x - other.x) + p.y * (one.y - other.y) + p.z * (one.z - other.z);
    const float terms = fabs(p.x) * (fabs(one.x) + fabs(other.x)) + fabs(p.y) * (fabs(one.y) + fabs(other.y))
                      + fabs(p.z) * (fabs(one.z) + fabs(other.z));
    return (int)(volume > ROUNDING * terms) - (int)(volume < -ROUNDING * terms);
}

/* True where all three corners surely lie on one side. */
static inline int apart(const int3 sides)
{
    const int sum = sides.x + sides.y + sides.z;
    return sum == 3 || sum == -3;
}

/* False where the line from p to q surely passes beside the triangle a, b, c, or where p and q lie on the same side. */
static inline int may_pass(
    const float3 p, const float3 q, const int side_p, const int side_q, const float3 a, const float3 b, const float3 c)
{
    if (side_p == side_q && side_p != 0)
        return 0;
    const int u = side_of(p, q, a, b), v = side_of(p, q, b, c), w = side_of(p, q, c, a);
    return !((u > 0 || v > 0 || w > 0) && (u < 0 || v < 0 || w < 0));
}

/* Parameters  vertices  in   (vertices, 3) coordinates, of which the largest has a magnitude of 1024 to 2048
 *             corners   in   (n, 3) vertices of the triangle of each entry
 *             low high  in   (n, 3) box of each entry
 *             starts    in   (rows + 1,) first entry of each row; those of a level side by side, z * ny + y
 *             levels    in   (levels, 4) first row, rows along y, rows along z, and the end of the entries of each level
 *             edges     in   (levels,) width of the rows, at least 1, ascending
 *             origin_y origin_z   lowest corner of all boxes
 *             marks     in and out  (n + 31 / 32,) bits of entries
 *             first items   the entries of this launch;  level_count: levels
 * Launch      global = items rounded up by the host, any local
 * Assumes     entries in the order of level, row and low x; boxes at most 0.998 edges long; at most 4096 rows along an axis
 * Guarantees  a bit is set for both triangles of each pair that cuts each other and shares no vertex; bits are only added.
 *             Races: marks by atomic_or() alone */
__kernel void mark_crossings(
    __global const float *restrict vertices, __global const uint *restrict corners, __global const float *restrict low,
    __global const float *restrict high, __global const uint *restrict starts, __global const uint *restrict levels,
    __global const float *restrict edges, __global uint *restrict marks, const float origin_y, const float origin_z,
    const uint first, const uint items, const uint level_count)
{
    if (get_global_id(0) >= items)
        return;
    const uint entry = first + get_global_id(0);
    const float3 begin = vload3(entry, low), end = vload3(entry, high);
    const uint ca = corners[3 * entry], cb = corners[3 * entry + 1], cc = corners[3 * entry + 2];
    const float3 a = vload3(ca, vertices), b = vload3(cb, vertices), c = vload3(cc, vertices);
    uint own_level = 0;
    while (entry >= levels[4 * own_level + 3])
        ++own_level;
    for (uint level = own_level; level < level_count; ++level) {
        const uint first_row = levels[4 * level];
        const int ny = (int)levels[4 * level + 1], nz = (int)levels[4 * level + 2];
        const float edge = edges[level], per_edge = 1.0f / edge;
        const float from_y = (begin.y - origin_y) * per_edge, from_z = (begin.z - origin_z) * per_edge;
        const int y0 = max((int)floor(from_y - 1.0f - SLACK), 0);
        const int y1 = min((int)floor((end.y - origin_y) * per_edge + SLACK), ny - 1);
        const int z0 = max((int)floor(from_z - (level == own_level ? SLACK : 1.0f + SLACK)), 0);
        const int z1 = min((int)floor((end.z - origin_z) * per_edge + SLACK), nz - 1);
        const float least_x = begin.x - (1.0f + SLACK) * edge;
        for (int z = z0; z <= z1; ++z)
            for (int y = y0; y <= y1; ++y) {
                const uint row = first_row + (uint)z * (uint)ny + (uint)y;
                uint place = starts[row];
                const uint row_end = starts[row + 1];
                if (level == own_level)
                    place = max(place, entry + 1u);
                uint beyond = row_end;
                while (place < beyond) { /* the first entry that begins at least_x or later */
                    const uint middle = place + (beyond - place) / 2u;
                    if (low[3 * middle] < least_x)
                        place = middle + 1u;
                    else
                        beyond = middle;
                }
                for (; place < row_end && low[3 * place] <= end.x; ++place) {
                    const float3 its_low = vload3(place, low), its_high = vload3(place, high);
                    if (its_high.x < begin.x || its_low.y > end.y || its_high.y < begin.y || its_low.z > end.z
                        || its_high.z < begin.z)
                        continue;
                    const uint cd = corners[3 * place], ce = corners[3 * place + 1], cf = corners[3 * place + 2];
                    if (ca == cd || ca == ce || ca == cf || cb == cd || cb == ce || cb == cf || cc == cd || cc == ce
                        || cc == cf)
                        continue;
                    const float3 d = vload3(cd, vertices), e = vload3(ce, vertices), f = vload3(cf, vertices);
                    const int3 ours = (int3)(side_of(d, e, f, a), side_of(d, e, f, b), side_of(d, e, f, c));
                    if (apart(ours))
                        continue;
                    const int3 its = (int3)(side_of(a, b, c, d), side_of(a, b, c, e), side_of(a, b, c, f));
                    if (apart(its))
                        continue;
                    if (may_pass(a, b, ours.x, ours.y, d, e, f) || may_pass(b, c, ours.y, ours.z, d, e, f)
                        || may_pass(c, a, ours.z, ours.x, d, e, f) || may_pass(d, e, its.x, its.y, a, b, c)
                        || may_pass(e, f, its.y, its.z, a, b, c) || may_pass(f, d, its.z, its.x, a, b, c)) {
                        atomic_or(&marks[entry / 32u], 1u << entry % 32u);
                        atomic_or(&marks[place / 32u], 1u << place % 32u);
                    }
                }
            }
    }
}
