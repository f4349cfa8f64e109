"""Mutations of kernels: every 7th work-item does nothing, items beyond number 500 do nothing, results are inverted.

A result is inverted by its type: a number with a sign is negated; bits, counts, places and labels become their
complement; a mark becomes the opposite mark, the least the greatest; triangles are wound the other way round.
"""

from __future__ import annotations

import hashlib
import re
from typing import NamedTuple

from point_inversions import POINT_INVERSIONS

from clrecon.opencl.sources import kernel_files, read_kernel_source

SKIPS = {"every 7th item": "get_global_id(0) % 7u == 3u", "items beyond 500": "get_global_id(0) > 500u"}

ONE_GROUP = "it is launched over one work-group of 64 items, whatever the data"
ONE_ITEM = "its only work-item with something to do is the first"
ON_GPUS = "CPUs do not launch it: RUSTICL_DEVICE_TYPE=gpu makes a device that does"
EQUIVALENT = {
    ("scan_block_sums", "items beyond 500"): ONE_GROUP,
    ("total_counts", "every 7th item"): ONE_ITEM,
    ("total_counts", "items beyond 500"): ONE_ITEM,
    **{("list_output", name): ON_GPUS for name in (*SKIPS, "inverted vertices", "inverted triangles")},
    ("find_first_edges", "inverted dirty"): "vertices beside which nothing has changed are looked at again",
}
"""Mutations that change nothing, with the reason."""

BITS = (("row_mask[w] = bits;", "row_mask[w] = ~bits;"),)
STORED_BITS = (("store_word(row_mask, w, bits, &set);", "store_word(row_mask, w, ~bits, &set);"),)
MARK = (("mask[word] = bits;", "mask[word] = ~bits;"),)
IMAGE = ("= finish_color(", "= (uchar4)(255) - finish_color(")
RAY_IMAGE = (("image[pixel] = finish_color(", "image[pixel] = (uchar4)(255) - finish_color("),)
RAY_DEPTHS = (("NAN : seen->first_hit + offset", "NAN : -seen->first_hit - offset"),)

INVERSIONS: dict[str, dict[str, tuple[tuple[str, str], ...]]] = {
    "count_set_bits": {"counts": (("= count;", "= 32u * COMPACT_WORDS - count;"),)},
    "list_set_bits": {
        "positions": (
            ("= 32 * word + popcount((bits & -bits) - 1);", "= 32 * word + 31 - popcount((bits & -bits) - 1);"),
        )
    },
    "sum_blocks": {"sums": (("= block;", "= ~block;"),)},
    "scan_block_sums": {
        "offsets": (("block_offsets[block] = offset;", "block_offsets[block] = ~offset;"),),
        "total": (("total[0] = before;", "total[0] = ~before;"),),
    },
    "scan_blocks": {"offsets": (("offsets[index] = offset;", "offsets[index] = ~offset;"),)},
    "count_digits": {"counts": (("= histogram[digit];", "= ~histogram[digit];"),)},
    "scatter_by_digit": {
        "keys": (("sorted_keys[place] = key;", "sorted_keys[place] = ~key;"),),
        "values": (("= numbered ? index : values[index];", "= ~(numbered ? index : values[index]);"),),
    },
    "enter_triangles": {
        "places": (("row[0] = at.x;", "row[0] = -at.x;"),),
        "names": (("stride + entry] = name;", "stride + entry] = name + corner;"),),
        "keys": (("+ step_of(grid, 0, low.x));", "- step_of(grid, 0, low.x));"),),
        "first rows": (("== row % ny)", "!= row % ny)"),),
        "reaches": (("atomic_max(", "atomic_min("),),
    },
    "mark_crossings": {
        "marks": (("if (found == APART ||", "if (found != APART ||"),),
        "certainty": (("found == CUT ? marks + ", "found != CUT ? marks + "),),
        "changes": (("&& has_moved(", "&& !has_moved("),),
    },
    "clear_labels": {"labels": (("= UNUSED;", "= ~UNUSED;"),)},
    "hook_corners": {"labels": (("min(corner.x, min(corner.y, corner.z))", "max(corner.x, max(corner.y, corner.z))"),)},
    "link_corners": {"corners": (("corner.y, first + 1)", "corner.y, first + 2)"),)},
    "follow_fans": {
        "mask": MARK,
        "labels": (("label = min(label, min(ends.x, ends.y));", "label = max(label, max(ends.x, ends.y));"),),
    },
    "jump_labels": {"labels": ((": follow_labels(", ": n - 1 - follow_labels("),)},
    "mark_mixed": {"mask": MARK},
    "mark_roots": {"mask": MARK},
    "gather_roots": {
        "corners": (
            (
                "(labels[corner.x], labels[corner.y], labels[corner.z])",
                "(~labels[corner.x], ~labels[corner.y], ~labels[corner.z])",
            ),
        )
    },
    "hook_roots": {"labels": (("min(a, min(b, c))", "max(a, max(b, c))"),)},
    "jump_roots": {"labels": (("= follow_labels(", "= ~follow_labels("),)},
    "copy_roots": {"labels": (("= labels[roots[place]];", "= ~labels[roots[place]];"),)},
    "flag_roots": {"marks": (("labels[vertex] == vertex", "labels[vertex] != vertex"),)},
    "number_components": {
        "numbers": (("numbers[vertex] = label == UNUSED ? -1 :", "numbers[vertex] = label == UNUSED ? 1 : -"),)
    },
    "copy_row_ends": {"ends": (("to[i] = from[clamp(", "to[i] = (VOXEL)-from[clamp("),)},
    "filter_bilateral": {
        "filtered": (
            (
                "choose(change < 0.0f, (floats)(-0.5f), (floats)(0.5f))",
                "choose(change < 0.0f, (floats)(0.5f), (floats)(-2.5f))",
            ),
        )
    },
    "average_patches": {
        "scratch": (("store_lanes(sum, sums + row", "store_lanes(-sum, sums + row"),),
        "weights": (
            ("store_lanes(load_lanes(weights + entry) + weight", "store_lanes(load_lanes(weights + entry) - weight"),
        ),
        "changes": (("fused(weight, away, load_lanes", "fused(-weight, away, load_lanes"),),
    },
    "finish_means": {"filtered": (("+ changes[entry] /", "- changes[entry] /"),)},
    "classify_groups": {
        "some": (("some_bits |= (uint)(is_in != 0)", "some_bits |= (uint)(is_in == 0)"),),
        "every": (("all_bits |= (uint)(is_out == 0)", "all_bits |= (uint)(is_out != 0)"),),
    },
    "spread_groups": {
        "some_near": (("some_near[word] = some_bits;", "some_near[word] = ~some_bits;"),),
        "all_near": (("all_near[word] = all_bits;", "all_near[word] = ~all_bits;"),),
    },
    "mark_mixed_groups": {"mask": (("mask[word] = some_bits & ~all_bits;", "mask[word] = ~(some_bits & ~all_bits);"),)},
    "measure_bricks": {
        "ranges": (
            ("range[0] = min(", "range[0] = (VOXEL)-min("),
            ("range[1]\n        = max(", "range[1]\n        = (VOXEL)-max("),
        )
    },
    "compare_bricks": {
        "states": (
            (
                "all_outside ? BRICK_OUTSIDE : all_inside ? BRICK_INSIDE",
                "all_outside ? BRICK_INSIDE : all_inside ? BRICK_OUTSIDE",
            ),
        ),
        "extents": (("(ushort)end);", "(ushort)~end);"),),
    },
    "measure_cells": {"ranges": (("= lowest;", "= (VOXEL)-lowest;"), ("= highest;", "= (VOXEL)-highest;"))},
    "mark_bricks": {"marks": (("? 0 : FARTHEST", "? FARTHEST : 0"),)},
    "spread_in_rows": {
        "distances": tuple((f"(uchar)distance.{c}", f"(uchar)(FARTHEST - distance.{c})") for c in "xyzw")
    },
    "spread_along": {
        "distances": (
            ("(spread + here) = best;", "(spread + here) = (uchar16)((uchar)FARTHEST) - best;"),
            ("spread[here] = (uchar)best;", "spread[here] = (uchar)(FARTHEST - best);"),
        )
    },
    "look_ahead": {"ways": (("(uchar)(free << 4 | own[0])", "(uchar)~(free << 4 | own[0])"),)},
    "fill_cells": {"density": (("? 0.0f : sum /", "? 0.0f : -sum /"),), "open": (("= 0.0f;\n}", "= 0.5f;\n}"),)},
    "sweep_light": {"open": (("+= weight * (1.0f - hidden);", "-= weight * (1.0f - hidden);"),)},
    "finish_openness": {"openness": (("= (VOXEL)floor(", "= (VOXEL)-floor("),)},
    "smooth_along": {"smoothed": (("= (VOXEL)value_of[lane];", "= (VOXEL)-value_of[lane];"),)},
    "enter_tiles": {"entries": (("= entry_of[lane];", "= -entry_of[lane];"),)},
    "composite_rays": {
        "image": (("image[place] = finish_color(color", "image[place] = (uchar4)(255) - finish_color(color"),),
        "depths": (("NAN : first_hit + offset_of", "NAN : -first_hit - offset_of"),),
    },
    "project_rays": {
        "values": (
            ("missed ? missing : which", "missed ? missing : -1.0f * (which"),
            ("sign * value_of[lane];", "sign * value_of[lane]);"),
        ),
        "depths": (("NAN : t_of[lane] + offset_of", "NAN : -t_of[lane] - offset_of"),),
    },
    "trace_surface": {"image": RAY_IMAGE, "depths": RAY_DEPTHS},
    "overlay_slices": {"image": RAY_IMAGE, "depths": RAY_DEPTHS},
    "clear_splats": {
        "keys": (("keys[pixel] = EMPTY;", "keys[pixel] = 0u;"),),
        "numbers": (("numbers[pixel] = EMPTY;", "numbers[pixel] = 0u;"),),
    },
    "splat_depths": {"keys": (("atomic_min(keys", "atomic_max(keys"),)},
    "splat_numbers": {"numbers": (("first + (uint)point", "~(first + (uint)point)"),)},
    "shade_splats": {
        "image": (("= finish_color((float4)(color", "= (uchar4)(255) - finish_color((float4)(color"),),
        "depths": (("? depth * length_of_ray : depth;", "? -depth * length_of_ray : -depth;"),),
    },
    "measure_bends": {
        "bends": (("bends[vertex] = weights", "bends[vertex] = -weights"),),
        "normals": (("normals[vertex] = (float4)(normal", "normals[vertex] = (float4)(-normal"),),
    },
    "filter_bends": {"sums": (("* sum)) - sums[vertex];", "* sum)) + sums[vertex];"),)},
    "sum_quadrics": {
        "quadrics": (
            ("store_quadric(quadrics, vertex, sum);", "sum.mixed = -sum.mixed; store_quadric(quadrics, vertex, sum);"),
        )
    },
    "rank_edges": {"octaves": (("octaves[edge] = octave;", "octaves[edge] = (uchar)~octave;"),)},
    "hang_points": {
        "points": (("(float4)(start.xyz, as_float(head))", "(float4)(-start.xyz, as_float(head))"),),
        "heads": (("heads[face] = count + face;", "heads[face] = LAST_POINT;"),),
    },
    "find_first_edges": {
        "firsts": (("firsts[vertex] = first;", "firsts[vertex] = NONE;"),),
        "dirty": (("dirty[vertex] = 0;", "dirty[vertex] = 1;"),),
    },
    "select_edges": {"chosen": (("= edge;\n}", "= opposite[edge];\n}"),)},
    "collapse_edges": {
        "places": (("places[u] = (float4)(place, 0.0f);", "places[u] = (float4)(-place, 0.0f);"),),
        "into": (("(uint4)(u, number, entry, own.size)", "(uint4)(w, number, entry, own.size)"),),
        "octaves": (("octaves[number] = octave_of(", "octaves[number] = (uchar)~octave_of("),),
        "earlier": (("earlier[w] = places[u];", "earlier[w] = -places[u];"),),
        "neighbours": (("neighbours[entry + i] = own.vertices[i];", "neighbours[entry + i] = u;"),),
        "homes": (("homes[u] = home;", "homes[u] = count - 1u - home;"),),
    },
    "frame_faces": {"frames": (("(float4)(one, max", "(float4)(-one, max"),)},
    "gather_stars": {"stars": (("star[0] = p.x;", "star[0] = -p.x;"),)},
    "find_near_faces": {"witnesses": (("(int4)(SEVERAL) : used", "(int4)(SEVERAL) : ~used"),)},
    "pair_faces": {
        "faces_at": (("faces_at[one] = (int)face;", "faces_at[one] = (int)(faces - 1u - face);"),),
        "below": (("below[face] = one;", "below[face] = NO_FACE;"),),
    },
    "sample_profiles": {"profiles": (("is_within, value", "is_within, -value"),)},
    "fit_profiles": {"fits": (("store_lanes(now.x0, fit);", "store_lanes(-now.x0, fit);"),)},
    "place_vertices": {"placed": (("placed[3 * vertex + axis] = (", "placed[3 * vertex + axis] = -("),)},
    "count_pieces": {"pieces": (("? 0 : count_across(b.left", "? 0 : ~count_across(b.left"),)},
    "draw_triangles": {
        "keys": (("atomic_min(keys", "atomic_max(keys"),),
        "numbers": (("atomic_min(numbers + at, number)", "atomic_min(numbers + at, ~number)"),),
    },
    "draw_pieces": {
        "keys": (
            ("draw_box(&c, &b, view[EYE_PIXEL], first + triangle", "draw_box(&c, &b, view[EYE_PIXEL], ~triangle"),
        ),
        "numbers": (("first + triangle, planes", "~(first + triangle), planes"),),
    },
    "shade_triangles": {
        "keys": (("keys[at] = EMPTY;", "keys[at] = 0u;"),),
        "layer": (("layer[at] = (float4)(rgb,", "layer[at] = (float4)(1.0f - rgb,"),),
        "layer_depths": (("= m.depth * length_of_ray", "= -m.depth * length_of_ray"),),
    },
    "clear_rays": {
        "states": (("states[2 * at] = (float4)(0.0f);", "states[2 * at] = (float4)(1.0f);"),),
        "marks": (("marks[at] = (float4)(NO_HIT, 0", "marks[at] = (float4)(1.0f, 0"),),
        "floor_keys": (("floor_keys[at] = 0;", "floor_keys[at] = EMPTY;"),),
    },
    "fill_depths": {"depths": (("= depth;", "= -depth;"),)},
    "begin_layer": {
        "keys": (("keys[at] = key;", "keys[at] = ~key;"),),
        "numbers": (("numbers[at] = EMPTY;", "numbers[at] = 0u;"),),
    },
    "show_still": {
        "keys": (("keys[at] = EMPTY;", "keys[at] = 0u;"),),
        "layer": (("layer[at] = convert_float4(seen) / 255.0f", "layer[at] = 1.0f - convert_float4(seen) / 255.0f"),),
        "layer_depths": (("= still_depths[at];", "= -still_depths[at];"),),
    },
    "blend_layer": {
        "states": (("seen.xyz += weight", "seen.xyz -= weight"),),
        "marks": (("mark.y += weight", "mark.y -= weight"),),
    },
    "count_open": {"open": (("atomic_add(open, found);", "atomic_add(open, found - found);"),)},
    "finish_rays": {
        "image": (IMAGE,),
        "depths": (("depths[at] = first;", "depths[at] = -first;"),),
        "means": (("? NAN : (mark.y", "? NAN : -(mark.y"),),
    },
    "reformat_rows": {
        "values": (("values[pixel] = value;", "values[pixel] = -value;"),),
        "weights": (("weights[pixel] = weight;", "weights[pixel] = -weight;"),),
    },
    "classify_samples": {"mask": STORED_BITS},
    "classify_bricks": {"mask": STORED_BITS},
    "count_rows": {
        "vertices": (("row_counts[row] = vertices;", "row_counts[row] = 99 * words - vertices;"),),
        "triangles": (("= triangles;", "= 99 * words - triangles;"),),
    },
    "total_counts": {"totals": (("totals[which] = (", "totals[which] = -("),)},
    "list_words": {"words": (("+ lowest_bit(flags);", "+ 31 - lowest_bit(flags);"),)},
    "list_output": {
        "vertices": (("make_entry(n, sample, lowest_bit(axes));", "~make_entry(n, sample, lowest_bit(axes));"),),
        "triangles": (("make_entry(n, sample, (uint)corners", "~make_entry(n, sample, (uint)corners"),),
    },
    "emit_vertices": {
        "positions": (("store_triples(PLACE(x), PLACE(y), PLACE(z)", "store_triples(-PLACE(x), -PLACE(y), -PLACE(z)"),),
        "normals": (
            ("store_triples(x * scale, y * scale, z * scale", "store_triples(-x * scale, -y * scale, -z * scale"),
        ),
    },
    "emit_triangles": {
        "winding": (
            ("= mirrored ? 8 : 0, last_shift = mirrored ? 0 : 8", "= mirrored ? 0 : 8, last_shift = mirrored ? 8 : 0"),
        )
    },
    "find_cell_runs": {"runs": (("= starts;", "= starts & starts >> 1;"),)},
    "begin_cell_runs": {
        "parents": (("parents[run] = run;", "parents[run] = 0u;"),),
        "cells": (("run_cells[run] = 0;", "run_cells[run] = 1;"),),
        "chosen": (("chosen[run] = 0;", "chosen[run] = 1;"),),
        "sums": (("sums[n] = 0;", "sums[n] = 1;"),),
    },
    "join_cell_runs": {
        "joins": (
            (
                "find_mixed_faces(load_window(mask, row + 1, w, words), y1z1,",
                "~find_mixed_faces(load_window(mask, row + 1, w, words), y1z1,",
            ),
            ("find_mixed_faces(y0z1, y1z1,", "~find_mixed_faces(y0z1, y1z1,"),
        )
    },
    "find_run_roots": {
        "roots": (("= find_root(parents, run);", "= run + 0 * find_root(parents, run);"),),
        "cells": (("cells += popcount(active);\n    }", "cells += 32 - popcount(active);\n    }"),),
    },
    "find_largest": {"largest": (("atomic_max(sums + LARGEST, run_cells[run])", "atomic_max(sums + LARGEST, 1u)"),)},
    "choose_largest": {"chosen": (("* parts >= sums[LARGEST])", "* parts < sums[LARGEST])"),)},
    "choose_cells": {"run": (("popcount(run_starts[at] & upto) - 1", "popcount(run_starts[at] & upto)"),)},
    "choose_seeded": {"marks": (("seeds_here = active & (uint)(corners", "seeds_here = active & ~(uint)(corners"),)},
    "sum_components": {
        "components": (("atomic_inc(sums + COMPONENTS);", "atomic_add(sums + COMPONENTS, 2u);"),),
        "cells": (("atomic_add(sums + CHOSEN_CELLS, cells)", "atomic_add(sums + CHOSEN_CELLS, cells + 1)"),),
    },
    "mark_grown": {"grown": (("? ~0u : 0u;\n        }\n        bits", "? 0u : ~0u;\n        }\n        bits"),)},
    "count_visited": {"counts": (("counts[row] = count;", "counts[row] = 32 * words - count;"),)},
    "count_cells": {
        "triangles": (("row_counts[rows_to_count + row] += more;", "row_counts[rows_to_count + row] -= more;"),),
        "vertices": (("row_cell_vertices[row] = vertices;", "row_cell_vertices[row] = 99 * words - vertices;"),),
    },
    "make_room": {"counts": (("] += cell", "] -= cell"),)},
    "emit_cell_triangles": {
        "winding": (
            ("= mirrored ? 8 : 0, last_shift = mirrored ? 0 : 8", "= mirrored ? 0 : 8, last_shift = mirrored ? 8 : 0"),
        )
    },
    "emit_cell_vertices": {
        "positions": (("vstore3(place, vertex, positions)", "vstore3(-place, vertex, positions)"),),
        "normals": (("vstore3(-up /", "vstore3(up /"),),
    },
    "own_samples": {"labels": (("(LABEL)find_owner(", "(LABEL)~find_owner("),)},
    "classify_label": {"mask": BITS},
    "clear_survey": {
        "boxes": (("= INT_MAX;", "= -INT_MAX;"), ("= INT_MIN;", "= INT_MAX;")),
        "faces": (("faces[2 * item + 1] = 0;", "faces[2 * item + 1] = ~0u;"),),
    },
    "find_boxes": {
        "boxes": tuple((f"atomic_min({box}", f"atomic_max({box}") for box in ("box, begin", "box + 1, j", "box + 2, k"))
    },
    "count_faces": {"faces": (("found->free);", "-found->free);"), ("found->shared);", "-found->shared);"))},
    "smooth_rows": {"sums": (("convert_ushort16(sum), 0", "(ushort)WHOLE - convert_ushort16(sum), 0"),)},
    "smooth_across": {"occupancy": (("as_short16(sum * (ushort)FINENESS)", "-as_short16(sum * (ushort)FINENESS)"),)},
    "classify_mask": {"mask": BITS},
    "clear_cells": {"mask": (("mask[word] = 0;", "mask[word] = ~0u;"),)},
    "mark_cells": {"mask": (("1u << (cell.x & 31)", "~(1u << (cell.x & 31))"),)},
    "count_marked": {"counts": (("= popcount(mask[word]);", "= 32 - popcount(mask[word]);"),)},
    "number_points": {"keys": (("keys[point] = ", "keys[point] = ~"),)},
    "merge_rows": {"cells": (("merged[item] = bits;", "merged[item] = ~bits;"),)},
    "mark_reached": {"bricks": (("bricks[item] = marked;", "bricks[item] = ~marked;"),)},
    "sort_normals": {"normals": tuple((f"= normal.{c};", f"= -normal.{c};") for c in "xyz")},
    "measure_nodes": {
        "values": (("vstore8(mean, ", "vstore8(1.0f - mean, "),),
        "near": (("near[byte] = row_bits(is_near)", "near[byte] = ~row_bits(is_near)"),),
        "core": (("core[byte] = row_bits(", "core[byte] = ~row_bits("),),
        "negative": (("(mean <= 0.0f)", "(mean > 0.0f)"),),
    },
    "fill_far": {
        "volume": (("(float8)(far_value) : (float8)(-far_value)", "(float8)(-far_value) : (float8)(far_value)"),)
    },
    "place_bricks": {"volume": (("? either : -either", "? -either : either"),)},
    "count_runs": {"counts": (("counts[row] = count;", "counts[row] = ~count;"),)},
    "list_runs": {
        "firsts": (("firsts[begun++] = 32 * word +", "firsts[begun++] = nx - 32 * word -"),),
        "lasts": (("lasts[ended++] = 32 * word +", "lasts[ended++] = nx - 32 * word -"),),
    },
    "count_joins": {"counts": (("counts[row] = join_row(", "counts[row] = ~join_row("),)},
    "list_joins": {"pairs": (("vstore3((uint3)(a, b, b)", "vstore3((uint3)(b, b, b)"),)},
    "count_votes": {"votes": (("vstore2(sum, run, votes);", "vstore2(sum.yx, run, votes);"),)},
    "paint_regions": {
        "inside": (("inside[at] = negative[at];", "inside[at] = ~negative[at];"),),
        "reached": (("reached[at] = far;\n", "reached[at] = ~far;\n"),),
    },
    "flood_signs": {
        "inside": (("next_inside[at] = taken;", "next_inside[at] = ~taken;"),),
        "reached": (("next_reached[at] = now;", "next_reached[at] = ~now;"),),
    },
    "gather_points": {
        "points": (("= point.x;", "= -point.x;"), ("= point.y;", "= -point.y;"), ("= point.z;", "= -point.z;")),
        "starts": (("starts[cell] = place;", "starts[cell] = ~place;"), ("= n;", "= ~n;")),
    },
    "count_overlaps": {"counts": tuple((f"= {what};", f"= ~{what};") for what in ("own", "next", "second"))},
    "clear_words": {"mask": (("mask[word] = 0;", "mask[word] = ~0u;"),)},
    "set_bits": {"mask": (("1u << (voxel.x & 31)", "~(1u << (voxel.x & 31))"),)},
    "set_numbered_bits": {"mask": (("1u << (i & 31)", "~(1u << (i & 31))"),)},
    "find_extents": {"extents": (("(ushort)end);", "(ushort)~end);"),)},
    "spread_ball": {"mask": (("a = (piece.a ^ flip) & row.a", "a = ~(piece.a ^ flip) & row.a"),)},
    "mark_border_runs": {"marks": (("marks[numbers[run]] = 1;", "marks[numbers[run]] = 0;"),)},
    "mark_voxel_runs": {
        "marks": (("marks[component] = 1;", "marks[component] = 0;"),),
        "components": (("found[which] = component;", "found[which] = ~component;"),),
    },
    "combine_masks": {"mask": (("combined[word] = bits;", "combined[word] = ~bits;"),)},
    "invert_mask": {"mask": (("= ~mask[word] & within;", "= mask[word];"),)},
    "count_row_bits": {"counts": (("counts[row] = count;", "counts[row] = ~count;"),)},
    "replace_outside": {"voxels": (("& 1 ? own : outside;", "& 1 ? outside : own;"),)},
    "write_runs": {
        "mask": (("|= from_first & to_last;", "|= ~(from_first & to_last);"), ("|= to_last;", "|= ~to_last;"))
    },
    **POINT_INVERSIONS,
}
"""For each kernel what it stores, and the texts of its file that are replaced to invert that."""


class Mutation(NamedTuple):
    """One mutation of one kernel."""

    file: str
    kernel: str
    name: str

    @property
    def reason(self) -> str:
        """Why it changes nothing; empty where it has to be caught."""
        return EQUIVALENT.get((self.kernel, self.name), "")

    def source(self) -> str:
        """Return the text of the file with the mutation."""
        text = read_kernel_source(self.file)
        if self.name in SKIPS:
            return _skip(text, self.kernel, SKIPS[self.name])
        return _invert(text, self.kernel, self.name.removeprefix("inverted "))

    def key(self) -> str:
        """Return a hash of the kernel with its mutation."""
        return hashlib.sha256(f"{self.kernel}\n{self.name}\n{self.source()}".encode()).hexdigest()[:16]


def find_kernels() -> dict[str, str]:
    """Return the file of each kernel of cl/."""
    found = {}
    for file in kernel_files():
        for kernel in re.findall(r"__kernel\b[^;{]*?\bvoid\s+(\w+)\s*\(", _without_comments(read_kernel_source(file))):
            found[kernel] = file
    return found


def all_mutations() -> list[Mutation]:
    """Return every mutation of every kernel, file by file."""
    return [
        Mutation(file, kernel, name)
        for kernel, file in find_kernels().items()
        for name in (*SKIPS, *(f"inverted {what}" for what in INVERSIONS.get(kernel, {})))
    ]


def _without_comments(text: str) -> str:
    """Blank comments out; every place stays where it is."""
    blank = re.compile(r"[^\n]")
    return re.sub(r"/\*.*?\*/|//[^\n]*", lambda match: blank.sub(" ", match[0]), text, flags=re.DOTALL)


def _close(text: str, at: int) -> int:
    """Return the place of the bracket that closes the one at `at`."""
    pairs = {"(": ")", "{": "}"}
    opening, closing, depth = text[at], pairs[text[at]], 0
    for place in range(at, len(text)):
        depth += (text[place] == opening) - (text[place] == closing)
        if depth == 0:
            return place
    raise ValueError(f"a {opening} is not closed")


def _find_body(text: str, kernel: str) -> tuple[int, int]:
    """Return the places of the braces around the body of a kernel."""
    plain = _without_comments(text)
    head = next(re.finditer(rf"\bvoid\s+{kernel}\s*\(", plain), None)
    if head is None:
        raise ValueError(f"no kernel {kernel}")
    begin = plain.index("{", _close(plain, head.end() - 1))
    return begin, _close(plain, begin)


def _skip(text: str, kernel: str, condition: str) -> str:
    """Let work-items do nothing: return at once, or with barriers in the way leave out what they would store."""
    begin, end = _find_body(text, kernel)
    body = text[begin + 1 : end]
    if "barrier(" not in body:
        return f"{text[: begin + 1]}\n    if ({condition})\n        return;{body}{text[end:]}"
    stores = re.compile(r"(?m)^(\s*)(\w+\[.*\] [+]?= .*;)$")
    return text[: begin + 1] + stores.sub(rf"\1if (!({condition})) \2", body) + text[end:]


def _invert(text: str, kernel: str, what: str) -> str:
    """Replace in the body of the kernel, or, where a text is not there, in the functions that it calls."""
    for old, new in INVERSIONS[kernel][what]:
        begin, end = _find_body(text, kernel)
        body = text[begin:end]
        if old in body:
            text = text[:begin] + body.replace(old, new) + text[end:]
        elif old in text:
            text = text.replace(old, new)
        else:
            raise ValueError(f"{kernel}: {old!r} is not in its file")
    return text
