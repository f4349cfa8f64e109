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
 * signs of volumes and areas that exceed their rounding are those of exact arithmetic. */

/* Share of a volume's sum of absolute terms that its rounding does not reach. */
#define ROUNDING 0x1p-20f
/* What boxes and rows are taken longer by, in edges: more than the rounding of coordinates in float32. */
#define SLACK 1e-3f


/* The plane of a triangle: one corner, the normal, and for each of its parts the sum of its absolute terms. */
typedef struct { float3 corner, normal, terms; } plane;

static inline plane plane_of(const float3 a, const float3 b, const float3 c)
{
    const float3 p = b - a, q = c - a;
    const float3 one = p.yzx * q.zxy, other = p.zxy * q.yzx;
    const plane found = {a, one - other, fabs(one) + fabs(other)};
    return found;
}

/* Side of a plane on which a point lies, 1 or -1; 0 where float32 cannot tell. */
static inline int side_of(const plane *flat, const float3 point)
{
    const float3 r = point - flat->corner, parts = flat->normal * r, terms = flat->terms * fabs(r);
    const float volume = parts.x + parts.y + parts.z, bound = ROUNDING * (terms.x + terms.y + terms.z);
    return (int)(volume > bound) - (int)(volume < -bound);
}

/* Sides of a plane on which corners lie. */
static inline int3 sides_of(const plane *flat, const float3 a, const float3 b, const float3 c)
{
    return (int3)(side_of(flat, a), side_of(flat, b), side_of(flat, c));
}

/* True where all corners surely lie on one side, but for those that are common: float32 cannot tell of these. */
static inline int apart(const int3 sides, const int common)
{
    const int sum = sides.x + sides.y + sides.z;
    return common + sum == 3 || common - sum == 3;
}

/* Axis along which the triangle a, b, c looks largest. */
static inline int steepest(const float3 a, const float3 b, const float3 c)
{
    const float3 normal = fabs(cross3(b - a, c - a));
    return normal.x >= normal.y && normal.x >= normal.z ? 0 : normal.y >= normal.z ? 1 : 2;
}

/* A point seen along an axis. */
static inline float2 shadow(const float3 point, const int axis)
{
    return axis == 0 ? point.yz : axis == 1 ? point.zx : point.xy;
}

/* Side of the line from a to b on which c lies, 1 or -1; 0 where float32 cannot tell. */
static inline int turn_of(const float2 a, const float2 b, const float2 c)
{
    const float2 p = b - a, q = c - a;
    const float one = p.x * q.y, other = p.y * q.x, bound = ROUNDING * (fabs(one) + fabs(other));
    return (int)(one - other > bound) - (int)(one - other < -bound);
}

/* True where the edge from p to q surely lies beyond one of the edges of the triangle a, b, c, or beside all of it, as
 * seen along an axis: they then have no point in common. */
static inline int apart_in_shadow(
    const float3 from, const float3 to, const float3 first, const float3 second, const float3 third)
{
    const int axis = steepest(first, second, third);
    const float2 p = shadow(from, axis), q = shadow(to, axis);
    const float2 a = shadow(first, axis), b = shadow(second, axis), c = shadow(third, axis);
    const int inside = turn_of(a, b, c);
    if (inside != 0
        && ((turn_of(a, b, p) == -inside && turn_of(a, b, q) == -inside)
            || (turn_of(b, c, p) == -inside && turn_of(b, c, q) == -inside)
            || (turn_of(c, a, p) == -inside && turn_of(c, a, q) == -inside)))
        return 1;
    return apart((int3)(turn_of(p, q, a), turn_of(p, q, b), turn_of(p, q, c)), 0);
}

/* False where the line from p to q surely passes beside the triangle a, b, c, or where p and q lie on the same side. */
static inline int may_pass(
    const float3 p, const float3 q, const int side_p, const int side_q, const float3 a, const float3 b, const float3 c)
{
    if (side_p == side_q && side_p != 0)
        return 0;
    const plane first = plane_of(p, q, a), second = plane_of(p, q, b), third = plane_of(p, q, c);
    const int u = side_of(&first, b), v = side_of(&second, c), w = side_of(&third, a);
    if ((u > 0 || v > 0 || w > 0) && (u < 0 || v < 0 || w < 0))
        return 0;
    return !apart_in_shadow(p, q, a, b, c);
}

/* True where triangles in one plane with the common edge b, c and the third corners a and d may lie on one side of it. */
static inline int may_be_folded(const float3 a, const float3 b, const float3 c, const float3 d)
{
    const int axis = steepest(a, b, c);
    const float2 from = shadow(b, axis), to = shadow(c, axis);
    return turn_of(from, to, shadow(a, axis)) * turn_of(from, to, shadow(d, axis)) >= 0;
}

/* The triangle turned so that the corner whose flag is set comes first. */
static inline uint3 turned(const uint3 triangle, const int3 flags)
{
    return flags.x ? triangle : flags.y ? triangle.yzx : triangle.zxy;
}

/* One for each corner of a triangle that is a corner of the other, too. */
static inline int3 common_corners(const uint3 one, const uint3 other)
{
    return -((one == other) | (one == other.yzx) | (one == other.zxy));
}

/* False where triangles surely have nothing in common but `count` corners, flagged in `common`.  Of two with a common
 * corner only the edges opposite to it can pass through the other triangle. */
static inline int may_cut(
    const uint3 one, const uint3 two, const int3 common, const int count, __global const float *restrict vertices)
{
    const int3 flags = common_corners(two, one);
    const uint3 own = turned(one, count == 2 ? 1 - common : common), its = turned(two, count == 2 ? 1 - flags : flags);
    const float3 a = vload3(own.x, vertices), b = vload3(own.y, vertices), c = vload3(own.z, vertices);
    const float3 d = vload3(its.x, vertices), e = vload3(its.y, vertices), f = vload3(its.z, vertices);
    if (count == 2)
        return may_be_folded(a, b, c, d);
    const plane here = plane_of(a, b, c), there = plane_of(d, e, f);
    const int3 ours = sides_of(&there, a, b, c), theirs = sides_of(&here, d, e, f);
    if (may_pass(b, c, ours.y, ours.z, d, e, f) || may_pass(e, f, theirs.y, theirs.z, a, b, c))
        return 1;
    return count == 0
        && (may_pass(a, b, ours.x, ours.y, d, e, f) || may_pass(c, a, ours.z, ours.x, d, e, f)
            || may_pass(d, e, theirs.x, theirs.y, a, b, c) || may_pass(f, d, theirs.z, theirs.x, a, b, c));
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
 * Guarantees  a bit is set for both triangles of each pair that cuts each other; bits are only added.
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
    const uint3 this = vload3(entry, corners);
    const float3 a = vload3(this.x, vertices), b = vload3(this.y, vertices), c = vload3(this.z, vertices);
    const plane own = plane_of(a, b, c);
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
                    const uint3 that = vload3(place, corners);
                    const int3 common = common_corners(this, that);
                    const int count = common.x + common.y + common.z;
                    const float3 d = vload3(that.x, vertices), e = vload3(that.y, vertices);
                    const float3 f = vload3(that.z, vertices);
                    if (count == 3 || apart(sides_of(&own, d, e, f), count))
                        continue;
                    const plane other = plane_of(d, e, f);
                    if (!apart(sides_of(&other, a, b, c), count) && may_cut(this, that, common, count, vertices)) {
                        atomic_or(&marks[entry / 32u], 1u << entry % 32u);
                        atomic_or(&marks[place / 32u], 1u << place % 32u);
                    }
                }
            }
    }
}
