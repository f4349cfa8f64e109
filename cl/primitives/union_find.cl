/* Connected components of a triangle mesh: union-find over the vertices, linked along the edges of the triangles.
 *
 * A vertex of an iso surface lies on one edge of the grid and belongs to the one sheet that crosses it there, so this
 * equals union-find over the active cells, but with separate sheets of one cell kept apart.
 *
 * Reference: Shiloach and Vishkin 1982, "An O(log n) parallel connectivity algorithm": rounds of hooking and pointer
 * jumping.  A root that has a smaller neighbour hooks to the smallest; one that has none, and that nobody hooks to, has
 * a smaller neighbour in the next round.  So two rounds halve the roots at least: 2 log2(n) rounds at most.
 *
 * The label of a vertex is a vertex of the same component with a smaller number, or the vertex itself, which is then
 * called a root.  A triangle is mixed when its corners have different roots.
 *
 * Passes
 *   1. clear_labels, hook_corners   the first round, where every vertex is a root: no label need be read
 *   2. jump_labels                  labels of labels, until every label is a root (until `flags` says so)
 *   3. mark_mixed, mark_roots       triangles and roots for the other rounds, listed by compact.cl: few of the mesh
 *   4. gather_roots; then hook_roots and jump_roots on these lists alone, until no root hooks to another; the labels
 *      of all other vertices stay, and are roots of the first round; copy_roots brings both together
 *   5. flag_roots, scan.cl, number_components
 *
 * Triangles (4, 5, 8), (5, 8, 9), (1, 2, 9) and (9, 12, 13), each arrow from a vertex to its label:
 *
 *      hook_corners      1 <- 2, 9     9 <- 12, 13     4 <- 5, 8        9 has 1, the least of its triangles' corners
 *      jump_labels       1 <- 2, 9, 12, 13             4 <- 5, 8        all labels are roots; (5, 8, 9) is mixed
 *      hook_roots        1 <- 4
 *      copy_roots        1 <- 2, 9, 12, 13, 4          4 <- 5, 8        the label of each label is a root
 *
 * Races.  No item waits for another: what a launch writes is read by the next one, which the queue begins after it.
 * Within a launch, by what items write:
 *
 *   their own word     clear_labels, jump_labels, mark_mixed, mark_roots, gather_roots, flag_roots, number_components:
 *                      one word of the output an item, or three (gather_roots); the item of vertex 0 clears the flags
 *                      too.  jump_roots and copy_roots write the word of a root, from a list that has each root once.
 *                      What they read, no item writes: jumps go from one buffer of labels to the other.
 *   labels by minimum  hook_corners: items whose triangles share a vertex write its label.  hook_roots: items whose
 *                      triangles share a root write that root's label.  All do so by atomic_min() and none reads these
 *                      labels, so each ends as the least of what was there and what all items brought, in any order.
 *   a flag             jump_labels, jump_roots, hook_roots: several items write flags[0], or flags[1], all of them the
 *                      number of this pass, and none reads it: whichever is last, it is the same word.
 *
 * In one launch of hook_roots b may be hooked to a while c is hooked to b.  No circle can come of it: a label is never
 * above its vertex, and roots are hooked to smaller ones only.  So the labels after a launch follow from those before
 * it and from nothing else: the outcome is the same on every device.  A component's root is its smallest vertex. */
#define UNUSED 0xffffffffu

#ifndef JUMPS
#define JUMPS 8
#endif

/* Follow the labels from one, JUMPS times or until a root. */
static inline uint follow_labels(
    __global const uint *restrict labels, uint label, __global uint *flags, const uint pass_number)
{
    uint next = labels[label];
    for (int jump = 0; jump < JUMPS && next != label; ++jump) {
        label = next;
        next = labels[label];
    }
    if (next != label)
        flags[0] = pass_number;
    return label;
}

/* Parameters  labels  out  (n,) UNUSED
 *             flags   out  (2,) zeros; later the number of the last pass that changed something
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
 *             flags   out  [0]: pass_number where a label is not yet a root, else unchanged
 *             n       vertices
 *             pass_number    counts from 1
 * Launch      as clear_labels
 * Guarantees  a chain of c links becomes one of at most ceil(c / (JUMPS + 1));
 *             all items that write the flag write the same */
__kernel void jump_labels(
    __global const uint *restrict labels, __global uint *restrict jumped, __global uint *flags, const uint n,
    const uint pass_number)
{
    const uint vertex = get_global_id(0);
    if (vertex >= n)
        return;
    const uint label = labels[vertex];
    jumped[vertex] = label == UNUSED ? UNUSED : follow_labels(labels, label, flags, pass_number);
}

/* Parameters  triangles  in   (m, 3)
 *             labels     in   (n,) all of them roots
 *             mask       out  (words,) bit b of word w: triangle 32 w + b is mixed
 *             m          triangles
 * Launch      global = words = ceil(m / 32) rounded up by the host, any local
 * Guarantees  every word is written */
__kernel void mark_mixed(
    __global const uint *restrict triangles, __global const uint *restrict labels, __global uint *restrict mask,
    const uint m)
{
    const uint word = get_global_id(0);
    if (word > (m - 1) / 32)
        return;
    const uint begin = 32 * word;
    const uint count = min(32u, m - begin);
    uint bits = 0;
    for (uint bit = 0; bit < count; ++bit) {
        const uint3 corner = vload3(begin + bit, triangles);
        const uint root = labels[corner.x];
        bits |= (uint)(root != labels[corner.y] || root != labels[corner.z]) << bit;
    }
    mask[word] = bits;
}

/* Parameters  labels  in   (n,) all of them roots
 *             mask    out  (words,) bit b of word w: vertex 32 w + b is a root
 *             n       vertices
 * Launch      global = words = ceil(n / 32) rounded up by the host, any local
 * Guarantees  every word is written */
__kernel void mark_roots(__global const uint *restrict labels, __global uint *restrict mask, const uint n)
{
    const uint word = get_global_id(0);
    if (word > (n - 1) / 32)
        return;
    const uint begin = 32 * word;
    const uint count = min(32u, n - begin);
    uint bits = 0;
    for (uint bit = 0; bit < count; ++bit)
        bits |= (uint)(labels[begin + bit] == begin + bit) << bit;
    mask[word] = bits;
}

/* Parameters  triangles  in   (m, 3)
 *             mixed      in   (count,) the mixed triangles
 *             labels     in   (n,) all of them roots
 *             corners    out  (count, 3) the roots of their corners
 *             count      mixed triangles
 * Launch      global = count rounded up by the host, any local
 * Guarantees  every corner is written */
__kernel void gather_roots(
    __global const uint *restrict triangles, __global const uint *restrict mixed, __global const uint *restrict labels,
    __global uint *restrict corners, const uint count)
{
    const uint place = get_global_id(0);
    if (place >= count)
        return;
    const uint3 corner = vload3(mixed[place], triangles);
    vstore3((uint3)(labels[corner.x], labels[corner.y], labels[corner.z]), place, corners);
}

/* Parameters  corners  in      (count, 3) roots of the first round, as gathered
 *             labels   in      (n,) of these all roots
 *             hooked   in/out  (n,) of these that are roots now as labels; then each the smallest in a triangle with it
 *             flags    out     [1]: pass_number where a root was hooked, else unchanged
 *             count    mixed triangles;  pass_number counts from 1
 * Launch      as gather_roots
 * Guarantees  all items that write the flag write the same; without it each triangle lies in one component */
__kernel void hook_roots(
    __global const uint *restrict corners, __global const uint *restrict labels, __global uint *hooked,
    __global uint *flags, const uint count, const uint pass_number)
{
    const uint place = get_global_id(0);
    if (place >= count)
        return;
    const uint3 corner = vload3(place, corners);
    const uint a = labels[corner.x], b = labels[corner.y], c = labels[corner.z];
    if (a == b && b == c)
        return;
    const uint least = min(a, min(b, c));
    // The smallest root itself gains nothing, and in late rounds it is one address for all.
    if (a != least)
        atomic_min(hooked + a, least);
    if (b != least)
        atomic_min(hooked + b, least);
    if (c != least)
        atomic_min(hooked + c, least);
    flags[1] = pass_number;
}

/* As jump_labels, for the vertices of a list.
 *
 * Parameters  roots   in   (count,) the roots after the first round
 *             labels  in   (n,)
 *             jumped  out  (n,) of listed roots
 *             flags   out  [0], as in jump_labels
 *             count   listed roots
 *             pass_number    counts from 1
 * Launch      global = count rounded up by the host, any local */
__kernel void jump_roots(
    __global const uint *restrict roots, __global const uint *restrict labels, __global uint *restrict jumped,
    __global uint *flags, const uint count, const uint pass_number)
{
    const uint place = get_global_id(0);
    if (place < count)
        jumped[roots[place]] = follow_labels(labels, labels[roots[place]], flags, pass_number);
}

/* Parameters  roots   in   (count,)
 *             labels  in   (n,)
 *             copy    out  (n,) of listed roots as labels
 *             count   listed roots
 * Launch      as jump_roots */
__kernel void copy_roots(
    __global const uint *restrict roots, __global const uint *restrict labels, __global uint *restrict copy,
    const uint count)
{
    const uint place = get_global_id(0);
    if (place < count)
        copy[roots[place]] = labels[roots[place]];
}

/* Parameters  labels  in   (n,)
 *             roots   out  (n,) 1 for roots, else 0
 *             n       vertices
 * Launch      as clear_labels */
__kernel void flag_roots(__global const uint *restrict labels, __global uint *restrict roots, const uint n)
{
    const uint vertex = get_global_id(0);
    if (vertex < n)
        roots[vertex] = labels[vertex] == vertex;
}

/* Parameters  labels   in   (n,) the label of each label is a root
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
    numbers[vertex] = label == UNUSED ? -1 : (int)offsets[labels[label]];
}
