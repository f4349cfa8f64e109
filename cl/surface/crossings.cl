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
 * An item looks at the entries behind its own of its level, at those of the next level with shorter triangles, and at
 * those of longer ones beyond the next: each pair is seen once, and most triangles look for no longer ones.  Both of
 * its triangles are marked, by atomic_or(), unless float32 shows that they do not cut each other: signs of volumes
 * and areas that exceed their rounding are those of exact arithmetic.
 *
 * Triangles that have moved since are entered once more, behind all others, in levels of their own; these items look at
 * all older levels, too.  What was entered before stays: a mark too many is found out by the exact look.
 *
 * LANES entries are looked at together: boxes, and sides of both planes, which leave few pairs. */
#include "include/lanes.h"


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

/* Planes of LANES triangles at once, and points. */
typedef struct { floats x, y, z; } points;
typedef struct { points corner, normal, terms; } planes;

static inline points spread(const float3 p)
{
    const points found = {(floats)(p.x), (floats)(p.y), (floats)(p.z)};
    return found;
}

/* Three rows of coordinates; a loop over all nine went by way of memory. */
static inline points points_at(__global const float *rows, const uint stride, const uint place)
{
    const points found = {load_lanes(rows + place), load_lanes(rows + (size_t)stride + place),
        load_lanes(rows + 2 * (size_t)stride + place)};
    return found;
}

static inline points away(const points p, const points q)
{
    const points found = {p.x - q.x, p.y - q.y, p.z - q.z};
    return found;
}

static inline planes planes_of(const points a, const points b, const points c)
{
    const points p = away(b, a), q = away(c, a);
    const floats yz = p.y * q.z, zy = p.z * q.y, zx = p.z * q.x, xz = p.x * q.z, xy = p.x * q.y, yx = p.y * q.x;
    const planes found = {
        a, {yz - zy, zx - xz, xy - yx}, {fabs(yz) + fabs(zy), fabs(zx) + fabs(xz), fabs(xy) + fabs(yx)}};
    return found;
}

/* As side_of(). */
static inline ints sides_of(const planes *flat, const points point)
{
    const points r = away(point, flat->corner);
    const floats volume = flat->normal.x * r.x + flat->normal.y * r.y + flat->normal.z * r.z;
    const floats bound
        = ROUNDING * (flat->terms.x * fabs(r.x) + flat->terms.y * fabs(r.y) + flat->terms.z * fabs(r.z));
    return choose(volume > bound, (ints)(1), (ints)(0)) - choose(volume < -bound, (ints)(1), (ints)(0));
}

/* True where the corners a, b and c surely lie on one side, but for those that are common: float32 cannot tell of these. */
static inline ints lie_apart(const planes *flat, const points a, const points b, const points c, const ints common)
{
    const ints sum = sides_of(flat, a) + sides_of(flat, b) + sides_of(flat, c);
    return (common + sum == 3) | (common - sum == 3);
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
    const int sum = turn_of(p, q, a) + turn_of(p, q, b) + turn_of(p, q, c);
    return sum == 3 || sum == -3;
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

/* A triangle, and the names of its corners. */
typedef struct { float3 a, b, c; uint3 names; } triangle;

static inline triangle triangle_at(
    __global const float *places, __global const uint *names, const uint stride, const uint entry)
{
    const size_t row = stride;
    __global const float *at = places + entry;
    const triangle found = {(float3)(at[0], at[row], at[2 * row]), (float3)(at[3 * row], at[4 * row], at[5 * row]),
        (float3)(at[6 * row], at[7 * row], at[8 * row]),
        (uint3)(names[entry], names[row + entry], names[2 * row + entry])};
    return found;
}

/* The triangle turned so that the corner whose flag is set comes first. */
static inline triangle turned(const triangle t, const int3 flags)
{
    const triangle next = {t.b, t.c, t.a, t.names.yzx}, last = {t.c, t.a, t.b, t.names.zxy};
    return flags.x ? t : flags.y ? next : last;
}

/* One for each corner of a triangle that is a corner of the other, too. */
static inline int3 common_corners(const uint3 one, const uint3 other)
{
    return -((one == other) | (one == other.yzx) | (one == other.zxy));
}

/* False where triangles surely have nothing in common but their common corners.  Of two with a common corner only the
 * edges opposite to it can pass through the other triangle. */
static inline int may_cut(const triangle one, const triangle two)
{
    const int3 common = common_corners(one.names, two.names), flags = common_corners(two.names, one.names);
    const int count = common.x + common.y + common.z;
    const triangle own = turned(one, count == 2 ? 1 - common : common), its = turned(two, count == 2 ? 1 - flags : flags);
    const float3 a = own.a, b = own.b, c = own.c, d = its.a, e = its.b, f = its.c;
    if (count == 2)
        return may_be_folded(a, b, c, d);
    const plane here = plane_of(a, b, c), there = plane_of(d, e, f);
    const int our_a = side_of(&there, a), our_b = side_of(&there, b), our_c = side_of(&there, c);
    const int its_d = side_of(&here, d), its_e = side_of(&here, e), its_f = side_of(&here, f);
    if (may_pass(b, c, our_b, our_c, d, e, f) || may_pass(e, f, its_e, its_f, a, b, c))
        return 1;
    return count == 0
        && (may_pass(a, b, our_a, our_b, d, e, f) || may_pass(c, a, our_c, our_a, d, e, f)
            || may_pass(d, e, its_d, its_e, a, b, c) || may_pass(f, d, its_f, its_d, a, b, c));
}

/* Entries from place on that may cut the triangle: its box overlaps theirs, and neither lies on one side of the other's
 * plane. */
static inline ints not_apart(
    __global const float *places, __global const uint *names, const uint stride, const uint place,
    const ints counts, const triangle *own, const plane *flat, const float3 begin, const float3 end)
{
    const points d = points_at(places, stride, place), e = points_at(places + 3 * (size_t)stride, stride, place);
    const points f = points_at(places + 6 * (size_t)stride, stride, place);
    ints left = counts & (greater(greater(d.x, e.x), f.x) >= begin.x) & (lesser(lesser(d.x, e.x), f.x) <= end.x);
    left &= (greater(greater(d.y, e.y), f.y) >= begin.y) & (lesser(lesser(d.y, e.y), f.y) <= end.y);
    left &= (greater(greater(d.z, e.z), f.z) >= begin.z) & (lesser(lesser(d.z, e.z), f.z) <= end.z);
    if (!ANY_LANE(left))
        return left;
    ints common = (ints)(0);
    for (int n = 0; n < 3; ++n) {
        const ints name = load_lanes((__global const int *)names + (size_t)n * stride + place);
        common += choose(
            (name == (int)own->names.x) | (name == (int)own->names.y) | (name == (int)own->names.z), (ints)(1), (ints)(0));
    }
    const planes here = {spread(flat->corner), spread(flat->normal), spread(flat->terms)};
    left &= (common != 3) & (lie_apart(&here, d, e, f, common) == 0);
    if (!ANY_LANE(left))
        return left;
    const planes there = planes_of(d, e, f);
    return left & (lie_apart(&there, spread(own->a), spread(own->b), spread(own->c), common) == 0);
}

/* Parameters  vertices   in   (vertices, 3) coordinates, of which the largest had a magnitude of 1024 to 2048
 *             triangles  in   (count, 3) their corners
 *             order      in   (count,) triangle of each entry
 *             places     out  (10, stride) coordinates of the corners of each entry, x y z of the first, of the second, of
 *                             the third; the lowest x
 *             names      out  (3, stride) corners of each entry
 *             marks  in and out  (stride + 31 / 32,) bits of entries
 *             first items   the entries that are written
 * Launch      global = items rounded up by the host, any local
 * Guarantees  entries from first + count on lie at infinity; a bit is set for each triangle without area.
 *             Races: marks by atomic_or() alone */
__kernel void enter_triangles(
    __global const float *restrict vertices, __global const uint *restrict triangles, __global const uint *restrict order,
    __global float *restrict places, __global uint *restrict names, __global uint *restrict marks, const uint first,
    const uint items, const uint count, const uint stride)
{
    const uint item = get_global_id(0), entry = first + item;
    if (item >= items)
        return;
    float low = INFINITY;
    for (uint corner = 0; corner < 3; ++corner) {
        const uint name = item < count ? triangles[3 * (size_t)order[item] + corner] : 0;
        const float3 at = item < count ? vload3(name, vertices) : (float3)(INFINITY);
        names[(size_t)corner * stride + entry] = name;
        __global float *row = places + 3 * (size_t)corner * stride + entry;
        row[0] = at.x;
        row[stride] = at.y;
        row[2 * (size_t)stride] = at.z;
        low = fmin(low, at.x);
    }
    places[9 * (size_t)stride + entry] = low;
    if (item >= count)
        return;
    const triangle own = triangle_at(places, names, stride, entry);
    const plane flat = plane_of(own.a, own.b, own.c);
    const int3 has_area = fabs(flat.normal) > ROUNDING * flat.terms;
    if (!(has_area.x || has_area.y || has_area.z))
        atomic_or(&marks[entry / 32u], 1u << entry % 32u);
}

/* Parameters  places names  in   (10, stride), (3, stride) see enter_triangles
 *             starts    in   (rows + 1,) first entry of each row; those of a level side by side, z * ny + y
 *             levels    in   (levels, 4) first row, rows along y, rows along z, and the end of the entries of each level
 *             edges     in   (levels, 4) width of the rows, longest side of the boxes, y and z that rows are counted from
 *             marks     in and out  (stride + 31 / 32,) bits of entries
 *             first items   the entries of this launch;  level_count: levels;  older: levels of entries that were entered
 *                            before these;  stride: at least n + LANES
 * Launch      global = items rounded up by the host, any local
 * Assumes     entries in the order of level, row and low x; at most 4096 rows along an axis
 * Guarantees  a bit is set for both triangles of each pair that touch each other beside common corners and have one of
 *             these entries; bits are only added.
 *             Races: marks by atomic_or() alone */
__kernel void mark_crossings(
    __global const float *restrict places, __global const uint *restrict names, __global const uint *restrict starts,
    __global const uint *restrict levels, __global const float *restrict edges, __global uint *restrict marks,
    const uint first, const uint items, const uint level_count, const uint older, const uint stride)
{
    if (get_global_id(0) >= items)
        return;
    const uint entry = first + get_global_id(0);
    __global const float *low_x = places + 9 * (size_t)stride;
    const triangle own = triangle_at(places, names, stride, entry);
    const float3 begin = fmin(fmin(own.a, own.b), own.c), end = fmax(fmax(own.a, own.b), own.c);
    const plane flat = plane_of(own.a, own.b, own.c);
    uint own_level = older;
    while (entry >= levels[4 * own_level + 3])
        ++own_level;
    for (uint level = 0; level < level_count; ++level) {
        if (level >= older && (level + 1 < own_level || level == own_level + 1))
            continue; /* their triangles look here */
        const uint first_row = levels[4 * level];
        const int ny = (int)levels[4 * level + 1], nz = (int)levels[4 * level + 2];
        const float per_edge = 1.0f / edges[4 * level], reach = (1.0f + SLACK) * edges[4 * level + 1];
        const float origin_y = edges[4 * level + 2], origin_z = edges[4 * level + 3];
        const float from_y = (begin.y - reach - origin_y) * per_edge;
        const float from_z = (begin.z - (level == own_level ? 0.0f : reach) - origin_z) * per_edge;
        const int y0 = max((int)floor(from_y - SLACK), 0);
        const int y1 = min((int)floor((end.y - origin_y) * per_edge + SLACK), ny - 1);
        const int z0 = max((int)floor(from_z - SLACK), 0);
        const int z1 = min((int)floor((end.z - origin_z) * per_edge + SLACK), nz - 1);
        const float least_x = begin.x - reach;
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
                    if (low_x[middle] < least_x)
                        place = middle + 1u;
                    else
                        beyond = middle;
                }
                for (; place < row_end && low_x[place] <= end.x; place += LANES) {
                    const ints counts = LANE_NUMBERS < (float)(row_end - place);
                    const ints left = not_apart(places, names, stride, place, counts, &own, &flat, begin, end);
                    if (!ANY_LANE(left))
                        continue;
                    int lanes[LANES];
                    store_lanes(left, lanes);
                    for (uint lane = 0; lane < LANES; ++lane) {
                        const uint other = place + lane;
                        if (lanes[lane] && may_cut(own, triangle_at(places, names, stride, other))) {
                            atomic_or(&marks[entry / 32u], 1u << entry % 32u);
                            atomic_or(&marks[other / 32u], 1u << other % 32u);
                        }
                    }
                }
            }
    }
}
