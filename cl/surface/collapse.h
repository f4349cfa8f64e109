/* The patch around an edge that may collapse: its ring, the place of the vertex that stays, and the tests.
 *
 * Arguments are not `restrict`: inlined, it becomes an instruction that Oclgrind 21.10 does not know.  Loops end by their
 * conditions alone: out of returns from nested ones no valid SPIR-V is made. */
#ifndef CLRECON_COLLAPSE_H
#define CLRECON_COLLAPSE_H

#include "surface/face_frames.h"
#include "surface/picks.h"

#define NONE 0xffffffffu
#define LAST_POINT 0x0fffffffu /* after the last point of a list: numbers of points have 28 bits */
#define REFUSED 255
#define GROUP 64
#define MOST_RING 16 /* numbers of its faces have 4 bits */
#define PULL 0.001f        /* weight of the middle of an edge: it decides where planes leave a direction open */
#define LENGTH_WEIGHT 0.0001f /* of the square of the length of an edge, beside its cost */
#define STEEPEST 0.2f      /* least cosine between the normals of a face before and after */
#define SLENDER 0.01f      /* sine below which a normal is not looked at: twice the area beside the longest edge */
#define EASY 0.36f         /* share of the limit within which a point stays at its face */
#define EASY_GIVEN 0.36f   /* share of the limit below which no nearer face of the given surface is looked for */
#define MOST_WALKS 6       /* vertices of the given surface from which a face near a point is looked for */
#define OMEGA 2.0f         /* a point of a new edge is followed by one this many times as far away as the limit allows */

static inline uint next_of(const uint edge) { return edge % 3u == 2u ? edge - 2u : edge + 1u; }

static inline uint last_of(const uint edge) { return edge % 3u == 0u ? edge + 2u : edge - 1u; }

/* The next half-edge from the same vertex, counterclockwise. */
static inline uint edge_after(__global const uint *opposite, const uint edge)
{
    return opposite[last_of(edge)];
}

/* Rank of an edge: the hash is one to one, so that no two edges have the same. */
static inline ulong rank_of(const uchar octave, const uint number)
{
    uint hash = number * 0x9e3779b1u;
    hash ^= hash >> 15;
    hash *= 0x85ebca77u;
    hash ^= hash >> 13;
    return (ulong)octave << 32 | hash;
}

/* Sum of the squared distances to planes, weighted by twice their areas, about a place. */
typedef struct { float3 diagonal, mixed, linear; float rest, locked; } quadric;

static inline quadric load_quadric(__global const float4 *quadrics, const uint vertex)
{
    const float4 one = quadrics[3u * vertex], two = quadrics[3u * vertex + 1u], three = quadrics[3u * vertex + 2u];
    const quadric of = {(float3)(one.x, one.w, two.y), (float3)(one.y, one.z, two.x), (float3)(two.z, two.w, three.x), three.y,
        three.z};
    return of;
}

static inline void store_quadric(__global float4 *quadrics, const uint vertex, const quadric of)
{
    quadrics[3u * vertex] = (float4)(of.diagonal.x, of.mixed.x, of.mixed.y, of.diagonal.y);
    quadrics[3u * vertex + 1u] = (float4)(of.mixed.z, of.diagonal.z, of.linear.x, of.linear.y);
    quadrics[3u * vertex + 2u] = (float4)(of.linear.z, of.rest, of.locked, 0.0f);
}

static inline float3 multiplied(const quadric of, const float3 by)
{
    return (float3)(
        of.diagonal.x * by.x + of.mixed.x * by.y + of.mixed.y * by.z,
        of.mixed.x * by.x + of.diagonal.y * by.y + of.mixed.z * by.z,
        of.mixed.y * by.x + of.mixed.z * by.y + of.diagonal.z * by.z);
}

/* The same sum about a place that is `by` away. */
static inline quadric shifted(const quadric of, const float3 by)
{
    const float3 part = multiplied(of, by);
    const quadric to = {of.diagonal, of.mixed, of.linear + part, of.rest + dot3(of.linear, by) + dot3(of.linear + part, by),
        of.locked};
    return to;
}

/* The sum of two about the place from which they are `u` and `w` away. */
static inline quadric joined(const quadric one, const quadric two, const float3 u, const float3 w)
{
    const quadric a = shifted(one, -u), b = shifted(two, -w);
    const quadric sum = {a.diagonal + b.diagonal, a.mixed + b.mixed, a.linear + b.linear, a.rest + b.rest,
        max(a.locked, b.locked)};
    return sum;
}

/* The place of the least sum. */
static inline float3 best_place(const quadric of)
{
    const float pull = PULL * (of.diagonal.x + of.diagonal.y + of.diagonal.z);
    const float3 d = of.diagonal + pull, m = of.mixed;
    const float3 x = (float3)(d.y * d.z - m.z * m.z, m.y * m.z - m.x * d.z, m.x * m.z - m.y * d.y);
    const float3 y = (float3)(x.y, d.x * d.z - m.y * m.y, m.x * m.y - m.z * d.x);
    const float3 z = (float3)(x.z, y.z, d.x * d.y - m.x * m.x);
    const float all = d.x * x.x + m.x * x.y + m.y * x.z;
    if (!(all > 0.0f))
        return (float3)(0.0f);
    return -(float3)(dot3(x, of.linear), dot3(y, of.linear), dot3(z, of.linear)) * (1.0f / all);
}

static inline uchar octave_of(const quadric one, const quadric two, const float3 u, const float3 w, const float most)
{
    const float3 half_way = 0.5f * (w - u);
    const quadric sum = joined(one, two, -half_way, half_way);
    const float3 best = best_place(sum);
    const float weight = sum.diagonal.x + sum.diagonal.y + sum.diagonal.z;
    const float cost = max(sum.rest + dot3(sum.linear, best) + dot3(sum.linear + multiplied(sum, best), best), 0.0f);
    if (sum.locked > 0.0f || !(cost <= most * weight))
        return REFUSED;
    return (uchar)min(as_uint(cost + LENGTH_WEIGHT * weight * dot3(half_way, half_way)) >> 23, (uint)REFUSED - 1u);
}

/* Everything relative to the middle of the edge.  x, y, z: places of the vertices of the ring, and of the first one again;
 * from `center_ring` on relative to the new place.  fan: the face of each; near: a given vertex near it; waiting:
 * the next point of each list. */
typedef struct {
    __local float *x, *y, *z;
    __local uint *vertices, *fan, *near, *waiting;
    uint size, split;
    float3 origin, u, w, place, normal;
    float slope; /* largest square of the tangent between the normal and that of a face */
} patch;

static inline uint ring_after(const patch *own, const uint i) { return i + 1u == own->size ? 0u : i + 1u; }

static inline float3 ring_place(const patch *own, const uint i) { return (float3)(own->x[i], own->y[i], own->z[i]); }

/* The end of the edge that face i of the fan had.  By numbers: of a choice of two vectors compilers make one of addresses,
 * and keep both in memory. */
static inline float3 end_of_edge(const patch *own, const uint i)
{
    const int at_u = i < own->split;
    return (float3)(at_u ? own->u.x : own->w.x, at_u ? own->u.y : own->w.y, at_u ? own->u.z : own->w.z);
}

static inline void put_in_ring(patch *own, const uint i, const float3 place)
{
    own->x[i] = place.x;
    own->y[i] = place.y;
    own->z[i] = place.z;
}

/* Fill the ring and the fan; false where the collapse would change the topology, or the ring is too long. */
static inline int walk_ring(
    patch *own, __global const uint *corners, __global const uint *opposite,
    __global const float4 *places, const uint edge)
{
    uint size = 0;
    int fits = 1;
    for (uint side = 0; side < 2; ++side) {
        const uint first = side == 0 ? edge : opposite[edge], last = next_of(side == 0 ? opposite[edge] : edge);
        for (uint at = edge_after(opposite, first); fits && at != last; at = edge_after(opposite, at)) {
            fits = size < MOST_RING;
            if (fits) {
                const uint vertex = corners[next_of(at)];
                put_in_ring(own, size, places[vertex].xyz - own->origin);
                own->vertices[size] = vertex;
                own->fan[size] = at / 3u;
                own->near[size] = NONE;
                ++size;
            }
        }
        if (side == 0)
            own->split = size;
    }
    own->size = size;
    fits &= size >= 3u;
    for (uint i = 1; fits && i < size; ++i)
        for (uint j = 0; j < i; ++j)
            fits &= own->vertices[i] != own->vertices[j];
    if (fits)
        put_in_ring(own, size, ring_place(own, 0));
    return fits;
}

/* The place of the least sum of squares on the plane that keeps the volume; false where there is none. */
static inline int place_vertex(patch *own, const quadric sum)
{
    const float3 a = ring_place(own, 0), b = ring_place(own, own->split);
    float3 normal = cross3(own->w - own->u, a - own->u);
    float volume = dot3(normal, own->u);
    const float3 other = cross3(own->u - own->w, b - own->w);
    normal += other;
    volume += dot3(other, own->w);
    for (uint i = 0; i < own->size; ++i) {
        const float3 from = end_of_edge(own, i);
        const float3 one = ring_place(own, i), two = ring_place(own, i + 1u);
        const float3 of = cross3(one - from, two - from);
        normal += of;
        volume += dot3(of, from);
    }
    const float square = dot3(normal, normal);
    if (!(square > 0.0f))
        return 0;
    const float3 best = best_place(sum);
    own->normal = normal;
    own->place = best + normal * ((volume - dot3(normal, best)) * (1.0f / square));
    return 1;
}

/* False where a face would turn over, or be a line. */
static inline int keeps_normals(patch *own)
{
    int keeps = 1;
    const float normal = dot3(own->normal, own->normal);
    own->slope = 0.0f;
    for (uint i = 0; keeps && i < own->size; ++i) {
        const float3 from = end_of_edge(own, i);
        const float3 one = ring_place(own, i), two = ring_place(own, i + 1u);
        const float3 before = cross3(one - from, two - from), now = cross3(one - own->place, two - own->place);
        const float3 p = one - own->place, q = two - own->place, r = two - one, s = one - from, t = two - from;
        const float length = max(max(dot3(p, p), dot3(q, q)), dot3(r, r)), square = dot3(now, now);
        const float length_before = max(max(dot3(s, s), dot3(t, t)), dot3(r, r)), square_before = dot3(before, before);
        const float along = dot3(before, now);
        const float upward = max(dot3(now, own->normal), 0.0f), cosine = upward * upward;
        own->slope = max(own->slope, (normal * square - cosine) / cosine);
        const int had_normal = square_before > SLENDER * length_before * length_before;
        const int turns_little = along > 0.0f && along * along > STEEPEST * STEEPEST * square * square_before;
        keeps = square > SLENDER * SLENDER * length * length
            && (had_normal ? turns_little : dot3(now, own->normal) > 0.0f);
    }
    return keeps;
}

static inline void center_ring(patch *own)
{
    for (uint i = 0; i < MOST_RING + 1u; ++i)
        put_in_ring(own, i, i < own->size ? ring_place(own, i) - own->place : ring_place(own, 0));
}

#if LANES == 8
/* Squares of distances to eight faces of the fan from `at` on; MAXFLOAT beyond its end. */
static inline float8 squares_to_fan(const patch *own, const float3 away, const uint at)
{
    const float8 squares = squares_in_frames(
        (float8)(away.x), (float8)(away.y), (float8)(away.z), vload8(0, own->x + at), vload8(0, own->y + at),
        vload8(0, own->z + at), vload8(0, own->x + at + 1u), vload8(0, own->y + at + 1u), vload8(0, own->z + at + 1u));
    return (int8)(0, 1, 2, 3, 4, 5, 6, 7) < (int8)((int)own->size - (int)at) ? squares : (float8)(MAXFLOAT);
}

static inline void look_at_fan(const patch *own, const float3 away, float *least, uint *nearest)
{
    for (uint part = 0; part < own->size; part += 8u) {
        int lane;
        const float square = least_of(squares_to_fan(own, away, part), &lane);
        if (square < *least) {
            *least = square;
            *nearest = part + (uint)lane;
        }
    }
}
#else
static inline void look_at_fan(const patch *own, const float3 away, float *least, uint *nearest)
{
    for (uint i = 0; i < own->size; ++i) {
        const float3 p = ring_place(own, i), q = ring_place(own, i + 1u);
        const float square = square_in_frame(away.x, away.y, away.z, p.x, p.y, p.z, q.x, q.y, q.z);
        if (square < *least) {
            *least = square;
            *nearest = i;
        }
    }
}
#endif

/* The face of list i: those of the fan, then the two that disappear. */
static inline uint list_face(const patch *own, const uint i, const uint above, const uint below)
{
    return i < own->size ? own->fan[i] : i == own->size ? above : below;
}

/* Find a face of the fan for each point of the lists; false where one lies farther away than the limit from all.  (A point
 * of each list in turn: their loads do not wait for each other.)  farthest: square of the largest of their distances;
 * home: the given vertex among them that is nearest to the new place. */
static inline int land_points(
    const patch *own, __global float4 *points, __global const uint *heads, const uint above,
    const uint below, const uint count, const float limit, float *farthest, uint *home)
{
    float beside = MAXFLOAT;
    const float3 center = own->origin + own->place;
    for (uint i = 0; i < own->size + 2u; ++i) {
        own->waiting[i] = heads[list_face(own, i, above, below)];
        PREFETCH(points + own->waiting[i]);
    }
    int lands = 1;
    *farthest = 0.0f;
    for (uint left = own->size + 2u; lands && left > 0;) {
        left = 0;
        for (uint i = 0; lands && i < own->size + 2u; ++i) {
            const uint number = own->waiting[i], at = i < own->size ? i : i == own->size ? 0u : own->split;
            if (number != LAST_POINT) {
                const float4 point = points[number];
                const uint following = as_uint(point.w) & LAST_POINT;
                own->waiting[i] = following;
                PREFETCH(points + following);
                left += following != LAST_POINT;
                const float3 away = point.xyz - center, p = ring_place(own, at), q = ring_place(own, at + 1u);
                float least = square_in_frame(away.x, away.y, away.z, p.x, p.y, p.z, q.x, q.y, q.z);
                uint nearest = at;
                if (!(least <= EASY * limit))
                    look_at_fan(own, away, &least, &nearest);
                lands = least <= limit;
                *farthest = max(*farthest, least);
                if (lands) {
                    points[number].w = as_float(nearest << 28 | following);
                    if (number < count) {
                        own->near[nearest] = number;
                        if (dot3(away, away) < beside) {
                            beside = dot3(away, away);
                            *home = number;
                        }
                    }
                }
            }
        }
    }
    return lands;
}

static inline void rehang_points(
    const patch *own, __global float4 *points, __global uint *heads, const uint above, const uint below)
{
    /* all lists become one, then each point goes where it landed */
    uint all = LAST_POINT;
    for (uint i = 0; i < own->size + 2u; ++i) {
        const uint face = list_face(own, i, above, below);
        uint number = heads[face];
        heads[face] = LAST_POINT;
        while (number != LAST_POINT) {
            const uint kept = as_uint(points[number].w);
            points[number].w = as_float((kept & ~LAST_POINT) | all);
            all = number;
            number = kept & LAST_POINT;
        }
    }
    while (all != LAST_POINT) {
        const uint kept = as_uint(points[all].w), face = own->fan[kept >> 28];
        points[all].w = as_float(heads[face]);
        heads[face] = all;
        all = kept & LAST_POINT;
    }
}

/* Square of the distance from a point to a face of the given surface near it, less than `limit` if that is seen from
 * the vertex `home`; below `enough` nothing nearer is looked for.  `home` becomes a vertex near the point. */
static inline __attribute__((always_inline)) float square_to_given(
    const target *to, const float3 point, const float limit, const float enough, uint *home, int *near_face)
{
    float least = *near_face == NO_FACE ? MAXFLOAT : square_to(to, point, *near_face);
    uint vertex = *home;
    int is_going = !(least < enough);
    for (uint walk = 0; is_going && walk < MOST_WALKS; ++walk) {
        const float before = least;
        look_around(to, point, vertex, &least, near_face);
        is_going = *near_face != NO_FACE;
        if (is_going) {
            const uint here = vertex;
            vertex = nearest_corner(to, point, *near_face);
            *home = vertex;
            is_going = !(least < enough);
            if (is_going && (vertex == here || !(least < before))) { /* the other corners, once */
                const uint3 face = vload3((uint)*near_face, to->faces);
                for (uint corner = 0; corner < 3 && !(least < limit); ++corner)
                    look_around(to, point, PICK_3(face.x, face.y, face.z, corner), &least, near_face);
                const uint3 other = vload3((uint)*near_face, to->faces);
                vertex = other.x != here ? other.x : other.y;
                is_going = !(least < limit) && least < before;
            }
        }
    }
    return least;
}

/* The vertex of two that is nearer to a point; either may be NONE. */
static inline uint nearer(const target *to, const float3 point, const uint one, const uint two)
{
    if (one == NONE || two == NONE)
        return one == NONE ? two : one;
    const float3 away = place_of(to->places, one) - point, other = place_of(to->places, two) - point;
    return dot3(away, away) <= dot3(other, other) ? one : two;
}

/* True where the points of a new edge and its faces are as near to the given surface as the points of that one, which
 * are at most `farthest` (its square) away from them, show: between two of these a ridge rises `rise` at 90 degrees. */
static inline int is_flat(const patch *own, const uint i, const float farthest, const float rise, const float limit)
{
    const float3 way = ring_place(own, i);
    const float3 one = cross3(ring_place(own, i == 0u ? own->size - 1u : i - 1u), way);
    const float3 other = cross3(way, ring_place(own, i + 1u));
    const float cosine = dot3(one, other) / sqrt(dot3(one, one) * dot3(other, other));
    return sqrt(farthest) + rise * sqrt(max(1.0f - cosine, 0.0f) / (1.0f + cosine)) < sqrt(limit);
}

/* True where points of the new edges and faces lie near the given surface; those of flat ones are not looked at. */
static inline int fan_lies_near(
    const patch *own, const target *to, __global const uint *homes, const uint home, const float limit,
    const float step, const float square, const float farthest, const float rise)
{
    uint last = own->near[own->size - 1u], side = homes[own->vertices[0]];
    int is_near = 1;
    for (uint i = 0; is_near && i < own->size; ++i) {
        const uint after = ring_after(own, i), near = own->near[i], other = homes[own->vertices[after]];
        const float3 way = ring_place(own, i), other_way = ring_place(own, after);
        const float length = sqrt(dot3(way, way));
        int near_face = NO_FACE;
        const int flat = is_flat(own, i, farthest, rise, limit);
        float along = max(OMEGA * (sqrt(limit) - sqrt(square)), step);
        while (is_near && !flat && along < length) {
            const float3 point = own->origin + own->place + way * (along * (1.0f / length));
            uint at = nearer(to, point, nearer(to, point, near, last), nearer(to, point, home, side));
            const float here = square_to_given(to, point, limit, EASY_GIVEN * limit, &at, &near_face);
            is_near = here < limit;
            along += max(OMEGA * (sqrt(limit) - sqrt(here)), step);
        }
        if (is_near && !flat) {
            const float3 middle = own->origin + own->place + (way + other_way) * (1.0f / 3.0f);
            uint at = nearer(to, middle, near, nearer(to, middle, home, nearer(to, middle, side, other)));
            is_near = square_to_given(to, middle, limit, limit, &at, &near_face) < limit;
        }
        last = near;
        side = other;
    }
    return is_near;
}

#endif
