/* Collapses of edges in parallel rounds, each checked before it is made.
 *
 * Reference: M. Garland, P. Heckbert, "Surface simplification using quadric error metrics", 1997 (cost); P. Lindstrom,
 * G. Turk, "Fast and memory efficient polygonal simplification", 1998 (the place that keeps the volume).
 *
 *           a                 a         u moves to the place p, w disappears, and with it the faces u w a and w u b.
 *         / | \             / | \       The ring are the neighbours of both, counterclockwise from a over b to a; the
 *       .---u---.         .   |   .     fan are the faces (p, ring i, ring i + 1).
 *       | \ | / |         | \ | / |
 *       .---w---.   ->    .---p---.     Half-edge h = 3 f + i runs from corner i of face f to the next corner; the
 *         \ | /             \ | /       number of an edge is the lower one of its two half-edges.
 *           b                 b
 *
 * The rank of an edge is the octave of its cost, then a hash of its number.  An edge collapses in a round if it is the
 * first one at both ends and at all vertices of the ring: no two such edges have a face in common, so that each item
 * changes faces of its own alone, and the result does not depend on the order of items.
 *
 * Passes
 *   1. sum_quadrics      once: squares of distances to the planes around each vertex
 *   2. rank_edges        once: octaves of all edges
 *   3. hang_points       once: points of the given surface, in a list for each face
 *   4. find_first_edges  each round, at vertices beside changes: the first edge of each
 *   5. select_edges      each round: edges that come first in their ring
 *   6. collapse_edges    each round: those that pass all tests */

#include "surface/collapse.h"

/* Parameters  places    in   (count,) mm, the last component 0
 *             corners   in   (3 faces,) vertex from which each half-edge starts
 *             opposite  in   (3 faces,)
 *             leaving   in   (count,) a half-edge that starts from each vertex; NONE: the vertex is locked
 *             quadrics  out  (3 count,) of each vertex: xx xy xz yy, yz zz x y, z 1 of the quadric about itself, and 1 if it is
 *                       locked
 *             count
 * Launch      global = count, rounded up by the host, any local
 * Assumes     around a vertex with a half-edge there is one closed fan
 * Guarantees  written for every vertex */
__kernel void sum_quadrics(
    __global const float4 *restrict places, __global const uint *restrict corners,
    __global const uint *restrict opposite, __global const uint *restrict leaving, __global float4 *restrict quadrics,
    const uint count)
{
    const uint vertex = get_global_id(0);
    if (vertex >= count)
        return;
    quadric sum = {(float3)(0.0f), (float3)(0.0f), (float3)(0.0f), 0.0f, 1.0f};
    const uint begin = leaving[vertex];
    if (begin != NONE) {
        const float3 own = places[vertex].xyz;
        sum.locked = 0.0f;
        uint edge = begin;
        do {
            const float3 p = places[corners[next_of(edge)]].xyz - own, q = places[corners[last_of(edge)]].xyz - own;
            const float3 normal = cross3(p, q);
            const float area = sqrt(dot3(normal, normal));
            if (area > 0.0f) {
                const float3 part = normal * (1.0f / area);
                sum.diagonal += normal * part;
                sum.mixed += (float3)(normal.x * part.y, normal.x * part.z, normal.y * part.z);
            }
            edge = opposite[last_of(edge)];
        } while (edge != begin);
    }
    store_quadric(quadrics, vertex, sum);
}

/* Parameters  places, corners, opposite, quadrics   in   as above
 *             octaves   out  (half_edges,) octave of the cost of the edge with this number; REFUSED for locked ones
 *             half_edges
 *             most      mm2: edges whose planes lie farther away on average are refused
 * Launch      global = half_edges, rounded up by the host, any local
 * Assumes     as above
 * Guarantees  written for every half-edge; REFUSED for those that are no number of an edge */
__kernel void rank_edges(
    __global const float4 *restrict places, __global const uint *restrict corners,
    __global const uint *restrict opposite, __global const float4 *restrict quadrics, __global uchar *restrict octaves,
    const uint half_edges, const float most)
{
    const uint edge = get_global_id(0);
    if (edge >= half_edges)
        return;
    uchar octave = REFUSED;
    const uint one = corners[edge], other = corners[next_of(edge)];
    if (opposite[edge] != NONE && edge < opposite[edge])
        octave = octave_of(load_quadric(quadrics, one), load_quadric(quadrics, other), places[one].xyz,
            places[other].xyz, most);
    octaves[edge] = octave;
}

/* Parameters  places, corners, opposite, leaving   in   as above, of the given surface
 *             points    out  (count + 4 faces,) vertices, centroids and middles of half-edges; in the last component the
 *                       point after each in the list of its face
 *             heads     out  (faces,) the first point of each face
 *             faces, count
 *             longest   mm2: edges that are longer than this have their middles in the lists
 * Launch      global = faces, rounded up by the host, any local
 * Assumes     as above
 * Guarantees  the vertices that are not locked, all centroids and the middles of long edges are each in one list */
__kernel void hang_points(
    __global const float4 *restrict places, __global const uint *restrict corners,
    __global const uint *restrict opposite, __global const uint *restrict leaving, __global float4 *restrict points,
    __global uint *restrict heads, const uint faces, const uint count,
    const float longest)
{
    const uint face = get_global_id(0);
    if (face >= faces)
        return;
    float4 sum = 0.0f;
    uint head = LAST_POINT;
    for (uint edge = 3u * face; edge < 3u * face + 3u; ++edge) {
        const uint vertex = corners[edge];
        const float4 start = places[vertex], end = places[corners[next_of(edge)]], way = end - start;
        sum += start;
        if (leaving[vertex] == edge) {
            points[vertex] = (float4)(start.xyz, as_float(head));
            head = vertex;
        }
        if (opposite[edge] != NONE && edge < opposite[edge] && dot3(way.xyz, way.xyz) > longest) {
            const uint middle = count + faces + edge;
            points[middle] = (float4)(0.5f * (start.xyz + end.xyz), as_float(head));
            head = middle;
        }
    }
    points[count + face] = (float4)(sum.xyz * (1.0f / 3.0f), as_float(head));
    heads[face] = count + face;
}

/* Parameters  corners, opposite, octaves   in   as above; corners: NONE for faces that are gone
 *             leaving   in and out   as above; NONE also for vertices that are gone
 *             firsts    in and out  (count,) number of the edge of least rank at each vertex; NONE: there is none
 *             dirty     in and out  (count,) 1: edges at the vertex have changed; 0 afterwards
 *             vertices  in   (items,) the vertices that are looked at
 *             items
 * Launch      global = items, rounded up by the host, any local
 * Assumes     as above
 * Guarantees  written for each of the vertices that is dirty */
__kernel void find_first_edges(
    __global const uint *restrict corners, __global const uint *restrict opposite, __global uint *restrict leaving,
    __global const uchar *restrict octaves, __global uint *restrict firsts, __global uchar *restrict dirty,
    __global const uint *restrict vertices, const uint items)
{
    if (get_global_id(0) >= items)
        return;
    const uint vertex = vertices[get_global_id(0)];
    if (dirty[vertex] == 0)
        return;
    dirty[vertex] = 0;
    uint first = NONE;
    ulong least = ULONG_MAX;
    uint begin = leaving[vertex];
    if (begin != NONE && corners[begin] == NONE) { /* its face is gone; what was opposite to it then is not */
        begin = edge_after(opposite, begin);
        leaving[vertex] = begin;
    }
    if (begin != NONE) {
        uint edge = begin;
        do {
            const uint back = opposite[edge], number = min(edge, back);
            const ulong rank = rank_of(octaves[number], number);
            if (octaves[number] != REFUSED && rank < least) {
                least = rank;
                first = number;
            }
            edge = next_of(back);
        } while (edge != begin);
    }
    firsts[vertex] = first;
}

/* True where no vertex around `vertex` has an edge before that of `rank`. */
static inline int comes_first(
    __global const uint *corners, __global const uint *opposite, __global const uchar *octaves,
    __global const uint *firsts, const uint begin, const ulong rank)
{
    uint edge = begin;
    int is_first = 1;
    do {
        const uint other = firsts[corners[next_of(edge)]];
        is_first = other == NONE || rank_of(octaves[other], other) >= rank;
        edge = next_of(opposite[edge]);
    } while (is_first && edge != begin);
    return is_first;
}

/* Parameters  corners, opposite, octaves, firsts, vertices, items   in   as above
 *             chosen    out  (counts[0],) numbers of edges, in any order
 *             counts    in and out   number of edges that are chosen
 *             limit     highest octave of edges that are chosen
 * Launch      global = items, rounded up by the host, any local
 * Assumes     as above; counts[0] is 0 before
 * Guarantees  no two chosen edges have a face at their ends in common.  Races: counts by atomic_inc() alone */
__kernel void select_edges(
    __global const uint *restrict corners, __global const uint *restrict opposite, __global const uchar *restrict octaves,
    __global const uint *restrict firsts, __global const uint *restrict vertices, __global uint *restrict chosen,
    __global uint *restrict counts, const uint limit, const uint items)
{
    if (get_global_id(0) >= items)
        return;
    const uint vertex = vertices[get_global_id(0)], edge = firsts[vertex];
    if (edge == NONE || corners[edge] != vertex || octaves[edge] > limit || firsts[corners[next_of(edge)]] != edge)
        return;
    const ulong rank = rank_of(octaves[edge], edge);
    if (comes_first(corners, opposite, octaves, firsts, edge, rank)
        && comes_first(corners, opposite, octaves, firsts, opposite[edge], rank))
        chosen[atomic_inc(&counts[0])] = edge;
}

/* Parameters  corners, opposite, leaving, places, quadrics, octaves, dirty   in and out   the present surface, as above
 *             points, heads   in and out   the lists
 *             homes     in and out   (count,) a vertex of the given surface near each
 *             earlier   out  (count,) of vertices that are gone: place of the vertex that stayed, before the collapse
 *             into      out  (4 count,) of vertices that are gone: the one that stayed, the round, and where the ring
 *                       begins in `neighbours`, and its size
 *             neighbours   out   the rings of collapses
 *             counts    in and out   edges that are chosen, entries of `neighbours`, collapses
 *             first_places, first_corners, begin, around, frames, stars   in   the given surface, as for `find_near_faces`
 *             chosen    in   edges, of `select_edges`
 *             number    of the round
 *             limit     mm2: no point may lie farther away
 *             most      mm2: as for `rank_edges`
 *             spacing   mm: points of new edges are no farther apart
 *             rise      mm: see `is_flat`
 * Launch      global = counts[0] or more, rounded up by the host, local at most GROUP
 * Assumes     as above
 * Guarantees  the surface stays closed, and its volume but for rounding */
__kernel void collapse_edges(
    __global uint *restrict corners, __global uint *restrict opposite, __global uint *restrict leaving,
    __global float4 *restrict places, __global float4 *restrict quadrics, __global uchar *restrict octaves,
    __global uchar *restrict dirty, __global float4 *restrict points, __global uint *restrict heads,
    __global uint *restrict homes,
    __global float4 *restrict earlier, __global uint *restrict into, __global uint *restrict neighbours,
    __global uint *restrict counts, __global const float *restrict first_places,
    __global const uint *restrict first_corners, __global const int *restrict begin, __global const int *restrict around,
    __global const float4 *restrict frames, __global const float8 *restrict stars, __global const uint *restrict chosen,
    const uint count, const uint number, const float limit, const float most, const float spacing,
    const float rise)
{
    __local float rings[3 * GROUP * (MOST_RING + 1)];
    __local uint vertices[GROUP * MOST_RING], fans[GROUP * MOST_RING], nears[GROUP * MOST_RING];
    __local uint waiting[GROUP * (MOST_RING + 2)];
    if (get_global_id(0) >= counts[0])
        return;
    const uint edge = chosen[get_global_id(0)], back = opposite[edge];
    const uint u = corners[edge], w = corners[back];
    patch own;
    own.x = rings + 3 * get_local_id(0) * (MOST_RING + 1);
    own.y = own.x + MOST_RING + 1;
    own.z = own.y + MOST_RING + 1;
    own.vertices = vertices + get_local_id(0) * MOST_RING;
    own.fan = fans + get_local_id(0) * MOST_RING;
    own.near = nears + get_local_id(0) * MOST_RING;
    own.waiting = waiting + get_local_id(0) * (MOST_RING + 2);
    own.u = places[u].xyz;
    own.w = places[w].xyz;
    own.origin = 0.5f * (own.u + own.w);
    own.u -= own.origin;
    own.w -= own.origin;
    const quadric sum = joined(load_quadric(quadrics, u), load_quadric(quadrics, w), own.u, own.w);
    const uint home_u = homes[u], home_w = homes[w];
    uint home = NONE;
    int passes = walk_ring(&own, corners, opposite, places, edge) && place_vertex(&own, sum)
        && keeps_normals(&own);
    if (passes) {
        const float3 away_u = vload3(home_u, first_places) - own.origin - own.place;
        const float3 away_w = vload3(home_w, first_places) - own.origin - own.place;
        home = dot3(away_u, away_u) <= dot3(away_w, away_w) ? home_u : home_w;
        const target surface = {first_places, first_corners, begin, around, frames, stars};
        center_ring(&own);
        float farthest;
        passes = land_points(&own, points, heads, edge / 3u, back / 3u, count, limit, &farthest, &home);
        if (passes && !(sqrt(farthest) + rise * sqrt(own.slope) < sqrt(limit))) {
            int near_face = NO_FACE;
            const float square = square_to_given(
                &surface, own.place + own.origin, limit, EASY_GIVEN * limit, &home, &near_face);
            passes = square < limit
                && fan_lies_near(&own, &surface, homes, home, limit, spacing, square, farthest, rise);
        }
    }
    if (!passes) {
        octaves[edge] = REFUSED;
        dirty[u] = 1;
        dirty[w] = 1;
        return;
    }
    rehang_points(&own, points, heads, edge / 3u, back / 3u);
    const uint after = next_of(edge), before = last_of(edge), after_back = next_of(back), before_back = last_of(back);
    /* corners at w */
    uint at = edge_after(opposite, back);
    while (at != after) {
        corners[at] = u;
        at = edge_after(opposite, at);
    }
    const uint from_a = opposite[after], to_a = opposite[before];
    const uint from_b = opposite[after_back], to_b = opposite[before_back];
    opposite[from_a] = to_a;
    opposite[to_a] = from_a;
    opposite[from_b] = to_b;
    opposite[to_b] = from_b;
    leaving[u] = to_a;
    leaving[w] = NONE;
    for (uint corner = 0; corner < 3; ++corner) {
        corners[edge / 3u * 3u + corner] = NONE;
        corners[back / 3u * 3u + corner] = NONE;
    }
    earlier[w] = places[u];
    atomic_inc(&counts[2]);
    const uint entry = atomic_add(&counts[1], own.size);
    for (uint i = 0; i < own.size; ++i)
        neighbours[entry + i] = own.vertices[i];
    vstore4((uint4)(u, number, entry, own.size), w, into);
    const float3 place = own.place + own.origin;
    places[u] = (float4)(place, 0.0f);
    homes[u] = home;
    const quadric moved = shifted(sum, own.place);
    store_quadric(quadrics, u, moved);
    dirty[u] = 1;
    dirty[w] = 1;
    at = to_a;
    for (uint turn = 0; turn == 0 || at != to_a; ++turn) { /* of a do loop llvm-spirv 15 makes no valid SPIR-V here */
        const uint number = min(at, opposite[at]), neighbour = corners[next_of(at)];
        octaves[number] = octave_of(moved, load_quadric(quadrics, neighbour), place, places[neighbour].xyz, most);
        dirty[neighbour] = 1;
        at = edge_after(opposite, at);
    }
}

/* Parameters  points, heads   in   the lists
 *             faces_at  out  (faces,) of the given surface: the present face at the middle of each
 *             below     out  (faces,) of the present surface: a face of the given one at each; NO_FACE: there is none
 *             faces, count
 * Launch      global = faces, rounded up by the host, any local
 * Assumes     the middle of each face is in one list
 * Guarantees  written for every face */
__kernel void pair_faces(
    __global const float4 *restrict points, __global const uint *restrict heads, __global int *restrict faces_at,
    __global int *restrict below, const uint faces, const uint count)
{
    const uint face = get_global_id(0);
    if (face >= faces)
        return;
    int one = NO_FACE;
    for (uint number = heads[face]; number != LAST_POINT; number = as_uint(points[number].w) & LAST_POINT)
        if (number >= count && number < count + faces) {
            one = (int)(number - count);
            faces_at[one] = (int)face;
        }
    below[face] = one;
}
