/* Connected components of a triangle mesh: union-find over the vertices, linked along the edges of the triangles.
 *
 * A vertex of an iso surface lies on one edge of the grid and belongs to the one or two sheets that cross it there, so
 * these are also the components of the active cells, but with separate sheets of one cell kept apart.
 *
 * Reference: Shiloach and Vishkin 1982, "An O(log n) parallel connectivity algorithm" (rounds of hooking and pointer
 * jumping); hooking by atomic minimum as in the GPU codes that followed it.  A root that has a smaller neighbour hooks
 * to the smallest; one that has none, and that nobody hooked to, has a smaller neighbour in the next round.  So two
 * rounds halve the roots at least: 2 log2(n) rounds at most, few on surfaces.
 *
 * Passes
 *   1. clear_labels       no vertex is used, no flag is set
 *   2. hook_corners       the first round, where every label is the vertex itself: no label need be read
 *   3. jump_labels        labels of labels, until every label is a root (until `flags` says so)
 *   4. copy_labels, hook_labels, jump_labels, and again until no root hooks to another
 *   5. flag_roots, exclusive scan (scan.cl), number_components
 *
 * No item waits for another, no array is read by one item while another writes it except by atomics, and a minimum
 * does not depend on the order: the outcome is the same on every device.  The label of a component is its smallest
 * vertex. */
#define UNUSED 0xffffffffu

#ifndef JUMPS
#define JUMPS 8
#endif

/* Parameters  labels  out  (n,) UNUSED
 *             flags   out  (2,) zeros; later the number of the last pass that had something to say
 *             n       vertices
 * Launch      global = n rounded up by the host, any local
 * Guarantees  every label is written */
__kernel void clear_labels(__global uint *restrict labels, __global uint *restrict flags, const uint n)
{
    const uint vertex = get_global_id(0);
    if (vertex >= n)
        return;
    labels[vertex] = UNUSED;
    if (vertex == 0)
        flags[0] = flags[1] = 0;
}

/* Parameters  triangles  in      (m, 3) numbers of vertices, each below n
 *             labels     in/out  (n,) cleared; then the smallest vertex in one triangle with each vertex
 *             m          triangles
 * Launch      global = m rounded up by the host, any local
 * Guarantees  used vertices have a label not above their own number; the others stay UNUSED */
__kernel void hook_corners(__global const uint *restrict triangles, __global uint *labels, const uint m)
{
    const uint triangle = get_global_id(0);
    if (triangle >= m)
        return;
    const uint3 corner = vload3(triangle, triangles);
    const uint least = min(corner.x, min(corner.y, corner.z));
    atomic_min(labels + corner.x, least);
    atomic_min(labels + corner.y, least);
    atomic_min(labels + corner.z, least);
}

/* Parameters  labels  in   (n,) each not above the number of its vertex, or UNUSED
 *             jumped  out  (n,) the label of the label ..., JUMPS times or until it is a root
 *             flags   out  [0]: the pass where a label is not yet a root, else as it was
 *             n       vertices
 *             pass    counts from 1
 * Launch      as clear_labels
 * Guarantees  a chain of c links becomes one of at most ceil(c / (JUMPS + 1)); all who write the flag write the same */
__kernel void jump_labels(
    __global const uint *restrict labels, __global uint *restrict jumped, __global uint *flags, const uint n,
    const uint pass)
{
    const uint vertex = get_global_id(0);
    if (vertex >= n)
        return;
    uint label = labels[vertex];
    if (label != UNUSED) {
        uint next = labels[label];
        for (int jump = 0; jump < JUMPS && next != label; ++jump) {
            label = next;
            next = labels[label];
        }
        if (next != label)
            flags[0] = pass;
    }
    jumped[vertex] = label;
}

/* Parameters  labels  in   (n,)
 *             copy    out  (n,)
 *             n       vertices
 * Launch      as clear_labels */
__kernel void copy_labels(__global const uint *restrict labels, __global uint *restrict copy, const uint n)
{
    const uint vertex = get_global_id(0);
    if (vertex < n)
        copy[vertex] = labels[vertex];
}

/* Parameters  triangles  in      (m, 3)
 *             labels     in      (n,) all of them roots
 *             hooked     in/out  (n,) a copy of labels; then each root has the smallest root in a triangle with it
 *             flags      out     [1]: the round where a root was hooked, else as it was
 *             m          triangles
 *             round      counts from 1
 * Launch      as hook_corners
 * Guarantees  all who write the flag write the same; without it every triangle lies in one component */
__kernel void hook_labels(
    __global const uint *restrict triangles, __global const uint *restrict labels, __global uint *hooked,
    __global uint *flags, const uint m, const uint round)
{
    const uint triangle = get_global_id(0);
    if (triangle >= m)
        return;
    const uint3 corner = vload3(triangle, triangles);
    const uint a = labels[corner.x], b = labels[corner.y], c = labels[corner.z];
    if (a == b && b == c)
        return;
    const uint least = min(a, min(b, c));
    atomic_min(hooked + a, least);
    atomic_min(hooked + b, least);
    atomic_min(hooked + c, least);
    flags[1] = round;
}

/* Parameters  labels  in   (n,) all of them roots
 *             roots   out  (n,) 1 for roots, else 0
 *             n       vertices
 * Launch      as clear_labels */
__kernel void flag_roots(__global const uint *restrict labels, __global uint *restrict roots, const uint n)
{
    const uint vertex = get_global_id(0);
    if (vertex < n)
        roots[vertex] = labels[vertex] == vertex;
}

/* Parameters  labels   in   (n,) all of them roots
 *             offsets  in   (n,) exclusive scan of the roots
 *             numbers  out  (n,) components counted in the order of their roots; -1 for unused vertices
 *             n        vertices
 * Launch      as clear_labels
 * Guarantees  every number is written */
__kernel void number_components(
    __global const uint *restrict labels, __global const uint *restrict offsets, __global int *restrict numbers,
    const uint n)
{
    const uint vertex = get_global_id(0);
    if (vertex >= n)
        return;
    const uint label = labels[vertex];
    numbers[vertex] = label == UNUSED ? -1 : (int)offsets[label];
}
