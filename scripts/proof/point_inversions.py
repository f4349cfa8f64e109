"""Inversions of the results of kernels of points, see `kernel_mutations`."""

from __future__ import annotations

POINT_INVERSIONS: dict[str, dict[str, tuple[tuple[str, str], ...]]] = {
    "find_cores": {"mask": (("store_words(core,", "store_words(~core,"),)},
    "count_row_runs": {
        "runs": (("row_counts[row] = runs;", "row_counts[row] = 64 * words - runs;"),),
        "points": (("= points;", "= 64 * words - points;"),),
    },
    "list_row_runs": {
        "runs": (("(ushort2)((ushort)begin, (ushort)(column", "(ushort2)((ushort)~begin, (ushort)~(column"),)
    },
    "join_runs": {"labels": (("labels[run] = root;", "labels[run] = ~root;"),)},
    "count_links": {"counts": (("row_links[row] = find", "row_links[row] = ~find"),)},
    "list_links": {"links": (("(uint3)(a, b, b)", "(uint3)(~a, ~b, ~b)"),)},
    "label_points": {
        "labels": (("own + point + before, runs", "own + point, runs"), (", numbers[run]);", ", ~numbers[run]);"))
    },
    "flag_cores": {"flags": (("(core & rest & -rest) != 0", "(core & rest & -rest) == 0"),)},
    "choose_points": {"points": (("chosen[cell] = order", "chosen[cell] = ~order"),)},
    "label_crowded": {"labels": ((">= fewest ? cell : SPARSE", ">= fewest ? SPARSE : cell"),)},
    "hook_touching": {
        "labels": (("max(root, other_root), min(root, other_root)", "min(root, other_root), max(root, other_root)"),)
    },
    "mark_places": {"marks": (("= kinds[cell];", "= ~kinds[cell];"),)},
    "find_core_points": {
        "cores": (("? point.x : NAN;", "? NAN : point.x;"), ("core_x[at] = x[at];", "core_x[at] = NAN;")),
        "labels": (("labels[cell] = label;", "labels[cell] = ~label;"),),
    },
    "join_chunks": {
        "labels": (
            (
                "labels[max(root, other_root)] = min(root, other_root);",
                "labels[min(root, other_root)] = max(root, other_root);",
            ),
        )
    },
    "note_words": {"roots": (("roots[word] = root;", "roots[word] = ~root;"),)},
    "hook_cells": {
        "labels": (("max(root, other_root), min(root, other_root)", "min(root, other_root), max(root, other_root)"),)
    },
    "find_firsts": {"places": (("least = min(least, order[at]);", "least = order[at] ^ 1u;"),)},
    "mark_firsts": {"marks": (("1u << (firsts[cell] & 31)", "~(1u << (firsts[cell] & 31))"),)},
    "number_cells": {"numbers": (("numbers[cell] = number;", "numbers[cell] = ~number;"),)},
    "label_free_points": {
        "clusters": (("= (int)least;", "= ~(int)least;"),),
        "cores": (("= (uchar)is_core;", "= (uchar)!is_core;"),),
    },
    "count_pairs": {"pairs": (("pairs[cell] = (float)own", "pairs[cell] = -(float)own"),)},
    "restrict_mask": {"mask": (("mask[at] = kept;", "mask[at] = ~kept;"),)},
    "find_shell": {"shell": (("= bits & ~(before", "= ~bits | (before"),)},
    "count_points": {"counts": (("counts[row] = count;", "counts[row] = 32u * words - count;"),)},
    "emit_points": {
        "positions": (("(place.sum + place.rest).xyz", "-(place.sum + place.rest).xyz"),),
        "hu": (("= (float)row->voxels[i];", "= -(float)row->voxels[i];"),),
        "numbers": (("= row->number + (uint)i;", "= ~(row->number + (uint)i);"),),
    },
    "sum_volumes": {"sums": (("sums[item] = sum;", "sums[item] = -sum;"),)},
    "fit_planes": {
        "normals": tuple((f"store_rows(n{c} * size,", f"store_rows(n{c} * size + 0.1f,") for c in "xyz"),
        "variations": (("choose(longest > NO_PLANE, l, (floats)(0.0f))", "choose(longest > NO_PLANE, 0.3f - l, l)"),),
    },
    "orient_normals": {
        "oriented": (("vstore3(normal, number, oriented);", "vstore3(-normal, number, oriented);"),),
        "states": (("states[number] = state;", "states[number] = 3 - state;"),),
    },
    "find_gradients": {"gradients": (("vstore3(known,", "vstore3(-known,"),)},
    "filter_points": {
        "moves": tuple((f"scatter_rows(move * n{c},", f"scatter_rows(-move * n{c},") for c in "xyz"),
        "planes": (("scatter_rows(sigma_s, planes", "scatter_rows(-sigma_s, planes"),),
    },
    "filter_cells": {
        "moves": (("(float3)(move * nx, move * ny, move * nz)", "-(float3)(move * nx, move * ny, move * nz)"),)
    },
    "measure_distances": {
        "means": (("scatter_rows(sum / ", "scatter_rows(-sum / "),),
        "nearest": (("scatter_rows(second,", "scatter_rows(-second,"),),
    },
    "list_neighbours": {
        "neighbours": (
            ("own[t] = (int)c->sorted[t];", "own[t] = ~(int)c->sorted[t];"),
            ("(int)place : (int)(uint)key;", "(int)place : ~(int)(uint)key;"),
        ),
        "distances": (
            ("own_distances[t] = distance_of(", "own_distances[t] = -distance_of("),
            ("= as_float((uint)(key >> 32));\n}", "= -as_float((uint)(key >> 32));\n}"),
        ),
    },
}
