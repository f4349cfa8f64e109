"""The list of faults, rows 1 to 72: what each is, what is expected, and which tests hold it.

A test marked ``fault_row(NN)`` is found by its mark; the others are listed here as "file::function", the file below
tests/.  The guard is guards/test_fault_list.py.
"""

from __future__ import annotations

TRAPS = "reading/dicom/test_trap_matrix.py::test_each_trap_gets_its_verdict"
GEOMETRY = "reading/dicom/test_stack_geometry.py::"
PIXELS = "reading/dicom/test_pixels.py::"
SERIES = "reading/dicom/test_series_choice.py::"
HOSTILE = "reading/dicom/test_hostile_files.py::"
BAD_INPUT = "cli/test_bad_input.py::"
FILES = "system/test_files.py::"
SLABS = "operators/surface/test_slabs.py::"

ROWS: dict[int, tuple[str, tuple[str, ...]]] = {
    1: ("row and column spacing differ: right", (TRAPS, GEOMETRY + "test_voxels_lie_where_they_were_written")),
    2: ("random order, no extension, lying InstanceNumber: right", (TRAPS,)),
    3: (
        "tilt of 1, 2.5, 12, -20 degrees: exact by shear, told",
        (TRAPS, GEOMETRY + "test_gantry_tilt_is_in_the_report_and_warned_of"),
    ),
    4: (
        "one slice missing: refused; --allow-gaps: true positions, told",
        (TRAPS, "reading/dicom/test_trap_matrix.py::test_refused_row_is_read_on_request_within_its_bound"),
    ),
    5: ("spacing changes half way: exact positions, told", (TRAPS,)),
    6: ("drift of 0.19 mm a gap: exact positions, told", (TRAPS,)),
    7: ("one step off by 0.15 mm: told with its figures", (TRAPS,)),
    8: (
        "positions rounded to 0.01 mm: right, no warning",
        (GEOMETRY + "test_positions_rounded_to_a_hundredth_of_a_mm_are_even_without_a_warning",),
    ),
    9: ("duplicate slices: equal ones dropped and told, else phases", (TRAPS,)),
    10: (
        "two phases or times in one series: refused with their list; --phase",
        (TRAPS, "reading/dicom/test_phases.py::test_series_of_two_phases_is_refused_with_their_list"),
    ),
    11: (
        "localizer in the series: left out and told",
        (TRAPS, SERIES + "test_localizer_in_the_series_is_left_out_with_a_warning"),
    ),
    12: (
        "two series or patients: refused with their list; --series",
        (
            SERIES + "test_two_series_of_equal_size_are_refused_with_their_list",
            "reading/dicom/test_phases.py::test_series_of_two_patients_are_refused_with_their_list_and_without_their_ids",
        ),
    ),
    13: (
        "two FrameOfReferenceUIDs: refused",
        (TRAPS, GEOMETRY + "test_slice_with_another_frame_spacing_or_orientation_is_refused"),
    ),
    14: (
        "directions not unit or orthogonal: refused; a little: made orthonormal, told",
        (
            GEOMETRY + "test_slice_with_another_frame_spacing_or_orientation_is_refused",
            GEOMETRY + "test_skewed_directions_are_made_orthonormal_with_a_warning",
        ),
    ),
    15: (
        "orientation or position zero, NaN, short, missing: refused with file and tag",
        (GEOMETRY + "test_unsound_geometry_or_rescale_is_refused_by_file_and_element",),
    ),
    16: (
        "SliceThickness or SpacingBetweenSlices wrong or negative: not used, told",
        (
            TRAPS,
            GEOMETRY + "test_spacing_between_slices_that_the_positions_contradict_is_not_used_and_warned_of",
            GEOMETRY + "test_thickness_that_is_no_number_is_not_used_and_warned_of",
        ),
    ),
    17: ("feet first, prone, reversed, left-handed: the same in LPS", (TRAPS,)),
    18: ("oblique or sagittal acquisition: the same in LPS", (TRAPS,)),
    19: (
        "coordinates of 1e5 mm: right to 1e-3 mm",
        (TRAPS, "operators/surface/test_far_volumes.py::test_vertices_far_from_the_origin_lie_on_their_sphere"),
    ),
    20: (
        "a single slice: refused",
        (
            GEOMETRY + "test_stack_with_holes_or_of_one_slice_is_refused_in_one_line",
            BAD_INPUT + "test_mesh_of_an_input_without_a_usable_ct_series_is_refused_in_one_line_and_writes_nothing",
        ),
    ),
    21: (
        "Rows or Columns differ between slices: refused, the odd ones named",
        (GEOMETRY + "test_slice_with_another_number_of_rows_is_refused",),
    ),
    22: ("enhanced CT, geometry and rescale of each frame, unsorted frames: right", (TRAPS,)),
    23: (
        "PixelSpacing 0, negative, huge, with a decimal comma: refused",
        (TRAPS, GEOMETRY + "test_unsound_geometry_or_rescale_is_refused_by_file_and_element"),
    ),
    24: (
        "orientation jitter of 0.001 degrees: right",
        (TRAPS, GEOMETRY + "test_directions_that_jitter_by_a_thousandth_of_a_degree_are_averaged"),
    ),
    25: (
        "slope and intercept slice by slice: right; slope 0, NaN, infinite, text: refused",
        (
            PIXELS + "test_each_slice_is_rescaled_by_its_own_slope_and_intercept",
            GEOMETRY + "test_unsound_geometry_or_rescale_is_refused_by_file_and_element",
        ),
    ),
    26: (
        "padding of -2000 with a skin threshold: no tube",
        ("reading/dicom/test_padding.py::test_no_tube_at_any_iso_value_where_air_has_no_noise",),
    ),
    27: (
        "12-bit signed pixels under overlay bits: right HU",
        (PIXELS + "test_signed_values_of_twelve_bits_are_read_under_overlay_bits",),
    ),
    28: (
        "MONOCHROME1: told; colour, palette, secondary capture: refused",
        (
            PIXELS + "test_doubtful_values_are_kept_with_a_warning",
            PIXELS + "test_image_that_is_no_ct_slice_is_refused_with_its_element",
            "reading/dicom/test_doubtful_headers.py::test_secondary_capture_with_a_position_is_refused",
        ),
    ),
    29: (
        "RescaleType not HU, rescale missing: told",
        (
            PIXELS + "test_values_without_a_rescale_are_kept_with_a_warning",
            PIXELS + "test_doubtful_values_are_kept_with_a_warning",
        ),
    ),
    30: (
        "iso value outside of the data: refused with the range, no empty file",
        (
            BAD_INPUT + "test_iso_value_above_all_voxels_is_refused_with_the_highest_of_the_scan",
            "operators/surface/test_isosurface.py::test_an_iso_value_outside_the_data_is_refused_with_the_range",
        ),
    ),
    31: (
        "whole HU that equal the iso value: watertight",
        ("operators/surface/test_isosurface.py::test_surfaces_of_random_integers_at_every_iso_value_are_sound",),
    ),
    32: (
        "constant volume, NaN, infinite voxels: refused",
        (
            BAD_INPUT + "test_volume_of_one_value_is_refused",
            "geometry/test_iso_rule.py::test_voxels_that_are_not_finite_are_refused",
        ),
    ),
    33: (
        "metal cut off at 3071 HU: told",
        ("reading/dicom/test_doubtful_headers.py::test_metal_at_3071_hu_is_warned_of_from_a_few_voxels_on",),
    ),
    34: ("lossy compression: told", (PIXELS + "test_doubtful_values_are_kept_with_a_warning",)),
    35: (
        "empty, text, PNG, cut at every byte: refused or passed over, never a traceback",
        (
            BAD_INPUT + "test_mesh_of_an_input_without_a_usable_ct_series_is_refused_in_one_line_and_writes_nothing",
            "reading/dicom/test_truncation.py::test_series_with_a_slice_cut_anywhere_is_refused_unless_no_pixel_is_lost",
            "reading/dicom/test_lost_slices.py::test_file_that_may_be_left_of_a_slice_refuses_the_series",
        ),
    ),
    36: ("no preamble or meta header: only with --force", ()),
    37: ("sequences nested 300 or 5000 deep: refused", (HOSTILE + "test_deeply_nested_sequences_are_refused",)),
    38: ("deflate, RLE, JPEG 2000 bombs: refused before inflating", ()),
    39: (
        "65535 x 65535 voxels, 2^31 - 1 frames: refused before memory is taken",
        ("reading/dicom/test_multiframe_faults.py::test_faults_of_multi_frame_images_are_refused_by_name",),
    ),
    40: ("garbage for JPEG 2000 or JPEG-LS, a decoder that crashes: that file refused", ()),
    41: (
        "unknown, retired, private transfer syntax: refused with its UID",
        (HOSTILE + "test_slices_of_an_unknown_transfer_syntax_are_refused_by_its_uid",),
    ),
    42: (
        "big endian; implicit under explicit: right, told",
        (
            PIXELS + "test_native_transfer_syntaxes_give_the_same_hu",
            HOSTILE + "test_implicit_elements_under_an_explicit_syntax_are_read_with_a_warning",
        ),
    ),
    43: (
        "DICOMDIR, links, loops, pipes, devices, sockets, folders with names of files: nothing outside is opened",
        (SERIES + "test_links_and_pipes_are_passed_over",),
    ),
    44: ("a program in the preamble: read, told, never copied out", ()),
    45: (
        "hostile texts: never in names, escaped in messages",
        (SERIES + "test_hostile_descriptions_come_out_in_one_printable_line",),
    ),
    46: (
        "bad character set, no permission, a file that vanishes, a disk that hangs: named",
        (
            "reading/dicom/test_lost_slices.py::test_file_that_cannot_be_opened_refuses_the_series",
            "reading/dicom/test_lost_slices.py::test_folder_that_cannot_be_read_refuses_the_series",
        ),
    ),
    47: ("100,000 files, 10,000 series: headers only, bounded memory", ()),
    48: ("gz, zip, tar: bounded, or refused with what to do", ()),
    49: (
        "no platform or driver: refused with what to install",
        (
            "opencl/test_select.py::test_error_without_a_device_says_how_to_get_a_driver",
            "cli/test_commands.py::test_command_without_a_driver_is_refused_in_one_line_that_says_how_to_get_one",
        ),
    ),
    50: ("a simulator such as Oclgrind: never chosen silently", ()),
    51: (
        "no fp64, no images, small groups, 32-bit sizes, big endian: right, or refused in words",
        (
            "opencl/test_select.py::test_shortcoming_of_a_device_is_named",
            "operators/primitives/test_compaction.py::test_scan_on_devices_with_small_work_groups_equals_the_twin",
        ),
    ),
    52: ("a kernel that does not build, a kernel file that is missing: refused with the log or the file", ()),
    53: (
        "a volume above the memory of the device: slabs, the same bytes",
        (
            SLABS + "test_slabs_of_one_to_five_slices_give_the_same_mesh",
            SLABS + "test_a_volume_beyond_the_largest_buffer_of_the_device_goes_through_in_slabs",
        ),
    ),
    54: (
        "an allocation or launch that fails late: halved, tried again, then the CPU, told",
        (
            "operators/resident/test_device_volume.py::test_result_is_the_same_after_a_buffer_or_launch_failed_at_several_places",
        ),
    ),
    55: (
        "2^31 triangles, counters that wrap: 64-bit counts, refused by budget",
        (
            "operators/primitives/test_compaction.py::test_a_total_beyond_32_bits_is_exact",
            SLABS + "test_a_slab_with_counts_over_32_bits_is_refused",
            SLABS + "test_slabs_have_as_many_slices_as_have_fewer_than_2_to_the_32_words",
        ),
    ),
    56: ("a kernel that hangs, a device that is lost: signals work, a time limit, a fresh context, then the CPU", ()),
    57: ("a driver that computes wrongly: found by the self-test, the device is not chosen", ()),
    58: (
        "two processes on a device; a fork: right; told",
        ("operators/rays/test_render_robustness.py::test_a_forked_process_is_told_so_and_does_not_wait_forever",),
    ),
    59: ("a kernel cache that is damaged, full, read-only, another user's: not used, told", ()),
    60: ("order from atomics: every run writes the same bytes", ()),
    61: (
        "disk full, quota, EPERM, a folder, a name too long: refused, the older file intact",
        (
            FILES + "test_error_of_the_system_while_writing_is_told_in_one_line_and_leaves_the_older_file",
            FILES + "test_file_larger_than_the_free_space_is_refused_before_it_is_written",
            FILES + "test_file_beyond_the_largest_size_that_the_system_allows_is_refused_and_leaves_the_older_file",
            "exchange/test_mesh_files.py::test_writer_of_every_mesh_format_notices_a_full_disk",
        ),
    ),
    62: (
        "SIGINT, SIGTERM, SIGKILL in the middle: the older file intact, temporary files removed by the next run",
        (
            FILES + "test_process_that_is_stopped_while_writing_leaves_the_older_file",
            "cli/test_process.py::test_interrupted_phantom_ends_with_130_and_leaves_no_files",
        ),
    ),
    63: ("the target exists: replaced as a whole; --no-clobber: refused before any work", ()),
    64: (
        "two writers of one name: one whole file",
        (FILES + "test_six_threads_that_write_to_one_name_leave_one_whole_file",),
    ),
    66: (
        "closed streams, no terminal: no traceback, plain progress",
        (
            "cli/test_closed_streams.py::test_refused_command_with_closed_streams_keeps_its_exit_code_and_its_line_where_there_is_one",
            "cli/test_process.py::test_reader_that_leaves_early_is_no_error",
        ),
    ),
    67: (
        "an empty mesh; more faces or bytes than the format holds: refused",
        (
            "exchange/test_mesh_files.py::test_mesh_without_triangles_is_refused_and_nothing_is_written",
            "exchange/test_mesh_files.py::test_mesh_too_large_for_its_format_is_refused_with_formats_that_hold_it",
        ),
    ),
    68: (
        "STL header: 80 bytes, never begins with solid, no patient data",
        (
            "exchange/test_mesh_files.py::test_stl_has_frame_unit_and_number_of_triangles_in_its_header",
            "exchange/test_mesh_files.py::test_mesh_file_holds_no_patient_no_device_and_no_path",
        ),
    ),
    69: ("patient data in headers, comments, logs, names, cache: none; --keep-ids: hashed UIDs", ()),
    70: ("a head whose face is plain: told", ()),
    71: ("pickles, eval, yaml: never", ()),
    72: ("decimal comma, time zone, umask 000: the same bytes, private folders", ()),
}

PENDING = {65: "one bad case of 100: there is no command for cohorts yet"}
"""Rows without a test, and why."""
