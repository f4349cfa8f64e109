/* Triangles of a surface that may cut another one, for an exact look at these alone.
 *
 * Reference: Moeller 1997, "A fast triangle-triangle intersection test"; the bound of rounding is that of Shewchuk 1997,
 * "Adaptive precision floating-point arithmetic and fast robust geometric predicates", orient3d, doubled.
 *
 * Space is cut into rows along x. A triangle is entered in each row that its box touches; the entries of a row are sorted
 * by the lowest x of their boxes, in steps:
 *
 *     z   +-------+-------+
 *         |   +---|---+   |     a box in four rows: it meets another one in the rows that both touch, and the pair counts
 *         +---|---+---|---+     in the first of these along y and z, which is the first of one of them
 *         |   +---|---+   |
 *         +-------+-------+  y
 *
 * An item looks at the entries behind its own, up to those that begin behind its end.  Both triangles of a pair are
 * marked, by atomic_or(), unless float32 shows that they do not cut each other, and in a row of their own where it shows
 * that they do: signs of volumes and areas that exceed their rounding are those of exact arithmetic.
 *
 * Triangles that have moved since are entered once more, behind all others, in rows of a generation of their own; these
 * items look at all older generations, too, of which what has moved does not count.
 *
 * LANES entries are looked at together: boxes, and sides of both planes, which leave few pairs. */
#include "include/lanes.h"

/* Share of a volume's sum of absolute terms that its rounding does not reach. */
#define ROUNDING 0x1p-20f
#define BOTH 3 /* along y and along z: an entry in the first row that its triangle touches */
enum { APART, UNSURE, CUT }; /* what float32 tells of two triangles */
#define NOWHERE 0x7fffffff /* behind all rows */

/* Rows of the tables of entries: corners a, b, c of a triangle, x y z of each; and beside these. */
#define PLACES 9
#define NAMES 5
#define FIRST_ROWS 3 /* 1: in the first row along y that its triangle touches, 2: along z */
#define KEY 4 /* row * steps + step of the lowest x, which rises from entry to entry of a generation */

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

/* APART where the line from p to q surely passes beside the triangle a, b, c, or where p and q lie on the same side; CUT
 * where it surely passes through. */
static inline int may_pass(
    const float3 p, const float3 q, const int side_p, const int side_q, const float3 a, const float3 b, const float3 c)
{
    if (side_p == side_q && side_p != 0)
        return APART;
    const plane first = plane_of(p, q, a), second = plane_of(p, q, b), third = plane_of(p, q, c);
    const int u = side_of(&first, b), v = side_of(&second, c), w = side_of(&third, a);
    if ((u > 0 || v > 0 || w > 0) && (u < 0 || v < 0 || w < 0))
        return APART;
    if (side_p * side_q < 0 && (u + v + w == 3 || u + v + w == -3))
        return CUT;
    return apart_in_shadow(p, q, a, b, c) ? APART : UNSURE;
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

/* False where float32 cannot tell whether a triangle has an area. */
static inline int has_area(const plane *flat)
{
    const int3 exceeds = fabs(flat->normal) > ROUNDING * flat->terms;
    return exceeds.x || exceeds.y || exceeds.z;
}

/* APART where triangles surely have nothing in common but their common corners, CUT where an edge of one surely passes
 * through the other.  Of two with a common corner only the edges opposite to it can. */
static inline int compare_triangles(const triangle one, const triangle two)
{
    const int3 common = common_corners(one.names, two.names), flags = common_corners(two.names, one.names);
    const int count = common.x + common.y + common.z;
    const triangle own = turned(one, count == 2 ? 1 - common : common), its = turned(two, count == 2 ? 1 - flags : flags);
    const float3 a = own.a, b = own.b, c = own.c, d = its.a, e = its.b, f = its.c;
    if (count == 2)
        return may_be_folded(a, b, c, d) ? UNSURE : APART;
    const plane here = plane_of(a, b, c), there = plane_of(d, e, f);
    const int surest = has_area(&here) && has_area(&there) ? CUT : UNSURE;
    int3 sides = (int3)(side_of(&there, b), side_of(&there, c), side_of(&there, a));
    int3 its_sides = (int3)(side_of(&here, e), side_of(&here, f), side_of(&here, d));
    triangle edges = {b, c, a, own.names}, its_edges = {e, f, d, its.names};
    int found = APART;
    for (int edge = 0; edge < 3 && found != CUT && (edge == 0 || count == 0); ++edge) {
        found = max(found, may_pass(edges.a, edges.b, sides.x, sides.y, d, e, f));
        found = max(found, may_pass(its_edges.a, its_edges.b, its_sides.x, its_sides.y, a, b, c));
        edges = turned(edges, (int3)(0, 1, 0)), its_edges = turned(its_edges, (int3)(0, 1, 0));
        sides = sides.yzx, its_sides = its_sides.yzx;
    }
    return min(found, surest);
}

/* True where a vertex of an entry has moved since. */
static inline int has_moved(__global const float *vertices, const triangle t)
{
    const int3 moved = (vload3(t.names.x, vertices) != t.a) | (vload3(t.names.y, vertices) != t.b)
        | (vload3(t.names.z, vertices) != t.c);
    return moved.x || moved.y || moved.z;
}

/* Steps of a coordinate along an axis; grid: origin, steps per unit, and the last step of x, y and z. */
static inline int step_of(__global const float *grid, const int axis, const float coordinate)
{
    return (int)clamp((coordinate - grid[axis]) * grid[3 + axis], 0.0f, grid[6 + axis]);
}

/* Entries from place on that may cut the triangle: the pair counts in this row, its box overlaps theirs, and neither lies
 * on one side of the other's plane. */
static inline ints not_apart(
    __global const float *places, __global const int *names, const uint stride, const uint place, const int last_key,
    const int first_rows, const triangle *own, const plane *flat, const float3 begin, const float3 end)
{
    ints left = (load_lanes(names + KEY * (size_t)stride + place) <= last_key)
        & ((load_lanes(names + FIRST_ROWS * (size_t)stride + place) | first_rows) == BOTH);
    const points d = points_at(places, stride, place), e = points_at(places + 3 * (size_t)stride, stride, place);
    const points f = points_at(places + 6 * (size_t)stride, stride, place);
    left &= (greater(greater(d.x, e.x), f.x) >= begin.x) & (lesser(lesser(d.x, e.x), f.x) <= end.x);
    left &= (greater(greater(d.y, e.y), f.y) >= begin.y) & (lesser(lesser(d.y, e.y), f.y) <= end.y);
    left &= (greater(greater(d.z, e.z), f.z) >= begin.z) & (lesser(lesser(d.z, e.z), f.z) <= end.z);
    if (!ANY_LANE(left))
        return left;
    ints common = (ints)(0);
    for (int n = 0; n < 3; ++n) {
        const ints name = load_lanes(names + (size_t)n * stride + place);
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
 *             order rows in   (count,) triangle and row of each entry
 *             grid       in   (3, 3) see step_of
 *             places     out  (PLACES, stride) coordinates of the corners of each entry
 *             names      out  (NAMES, stride) corners of each entry, FIRST_ROWS, KEY
 *             reaches in and out  (rows,) longest side along x of the boxes of a row, as bits
 *             marks   in and out  ((stride + 31) / 32,) bits of entries
 *             first items   the entries that are written
 * Launch      global = items rounded up by the host, any local
 * Guarantees  entries from first + count on lie at infinity; a bit is set for each triangle without area.
 *             Races: marks by atomic_or(), reaches by atomic_max() alone */
__kernel void enter_triangles(
    __global const float *restrict vertices, __global const uint *restrict triangles, __global const uint *restrict order,
    __global const uint *restrict rows, __global const float *restrict grid, __global float *restrict places,
    __global uint *restrict names, __global uint *restrict reaches, __global uint *restrict marks, const uint first,
    const uint items, const uint count, const uint stride)
{
    const uint item = get_global_id(0), entry = first + item;
    if (item >= items)
        return;
    for (uint corner = 0; corner < 3; ++corner) {
        const uint name = item < count ? triangles[3 * (size_t)order[item] + corner] : 0;
        const float3 at = item < count ? vload3(name, vertices) : (float3)(INFINITY);
        names[(size_t)corner * stride + entry] = name;
        __global float *row = places + 3 * (size_t)corner * stride + entry;
        row[0] = at.x;
        row[stride] = at.y;
        row[2 * (size_t)stride] = at.z;
    }
    names[KEY * (size_t)stride + entry] = NOWHERE;
    names[FIRST_ROWS * (size_t)stride + entry] = 0;
    if (item >= count)
        return;
    const triangle own = triangle_at(places, names, stride, entry);
    const float3 low = fmin(fmin(own.a, own.b), own.c), high = fmax(fmax(own.a, own.b), own.c);
    const int row = (int)rows[item], ny = (int)grid[7] + 1;
    names[KEY * (size_t)stride + entry] = (uint)(row * ((int)grid[6] + 1) + step_of(grid, 0, low.x));
    names[FIRST_ROWS * (size_t)stride + entry]
        = (uint)(step_of(grid, 1, low.y) == row % ny) | (uint)(step_of(grid, 2, low.z) == row / ny) << 1;
    atomic_max(&reaches[row], as_uint(high.x - low.x));
    const plane flat = plane_of(own.a, own.b, own.c);
    if (!has_area(&flat))
        atomic_or(&marks[entry / 32u], 1u << entry % 32u);
}

/* Parameters  places names grid reaches  in   see enter_triangles
 *             starts    in   (older, rows + 1) first entry of each row of the older generations
 *             vertices  in   (vertices, 3) see enter_triangles, as they are now
 *             marks     in and out  (2, (stride + 31) / 32) bits of entries that may cut another one, and that surely do
 *             first items   the entries of this launch;  older: generations that were entered before these;  stride: at
 *                            least n + LANES
 * Launch      global = items rounded up by the host, any local
 * Assumes     entries of a generation in the order of their keys
 * Guarantees  a bit is set for both triangles of each pair that touch each other beside common corners and have one of
 *             these entries; where the second row has it, they cut each other; bits are only added.
 *             Races: marks by atomic_or() alone */
__kernel void mark_crossings(
    __global const float *restrict places, __global const uint *restrict names, __global const float *restrict grid,
    __global const float *restrict vertices, __global const uint *restrict starts, __global const uint *restrict reaches,
    __global uint *restrict marks, const uint first, const uint items, const uint older, const uint stride)
{
    if (get_global_id(0) >= items)
        return;
    const uint entry = first + get_global_id(0);
    __global const int *keys = (__global const int *)names + KEY * (size_t)stride;
    const triangle own = triangle_at(places, names, stride, entry);
    const float3 begin = fmin(fmin(own.a, own.b), own.c), end = fmax(fmax(own.a, own.b), own.c);
    const plane flat = plane_of(own.a, own.b, own.c);
    const int first_rows = (int)names[FIRST_ROWS * (size_t)stride + entry], bins = (int)grid[6] + 1;
    const int row = keys[entry] / bins, row_key = row * bins, last_key = row_key + step_of(grid, 0, end.x);
    const uint rows = ((uint)grid[7] + 1) * ((uint)grid[8] + 1);
    for (uint generation = 0; generation <= older; ++generation) {
        uint place = entry + 1, row_end = stride;
        if (generation < older) {
            __global const uint *of_row = starts + generation * (size_t)(rows + 1) + row;
            place = of_row[0];
            row_end = of_row[1];
            uint beyond = row_end;
            const int first_key = row_key + step_of(grid, 0, begin.x - as_float(reaches[row])) - 1; /* for rounding */
            while (place < beyond) { /* the first entry that may reach the box */
                const uint middle = place + (beyond - place) / 2u;
                if (keys[middle] < first_key)
                    place = middle + 1u;
                else
                    beyond = middle;
            }
        }
        for (; place < row_end && keys[place] <= last_key; place += LANES) {
            const ints left = not_apart(
                places, (__global const int *)names, stride, place, last_key, first_rows, &own, &flat, begin, end);
            if (!ANY_LANE(left))
                continue;
            int lanes[LANES];
            store_lanes(left, lanes);
            for (uint lane = 0; lane < LANES; ++lane) {
                const uint other = place + lane;
                if (!lanes[lane])
                    continue;
                const triangle its = triangle_at(places, names, stride, other);
                const int found = compare_triangles(own, its);
                if (found == APART || (generation < older && has_moved(vertices, its)))
                    continue;
                __global uint *row_of_marks = found == CUT ? marks + (stride + 31) / 32u : marks;
                atomic_or(&row_of_marks[entry / 32u], 1u << entry % 32u);
                atomic_or(&row_of_marks[other / 32u], 1u << other % 32u);
            }
        }
    }
}
