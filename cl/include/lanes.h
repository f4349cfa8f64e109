/* Vectors of LANES floats or ints, under names that do not depend on LANES.
 *
 * CPU drivers do not reliably make vector code of work-items that branch, so hot loops are written for LANES values at
 * once; on a GPU, where a work-item is a lane already, LANES is 1.  The host chooses (-D LANES=8). */
#ifndef CLRECON_LANES_H
#define CLRECON_LANES_H

#ifndef LANES
#define LANES 1
#endif

#if LANES == 8
typedef float8 floats;
typedef int8 ints;
#define to_floats convert_float8
#define load_lanes(pointer) vload8(0, pointer)
#elif LANES == 1
typedef float floats;
typedef int ints;
#define to_floats convert_float
#define load_lanes(pointer) (*(pointer))
#else
#error "LANES is 1 or 8"
#endif

/* Lanes of `yes` where the condition holds, of `no` elsewhere.  OpenCL's select() takes true to be -1 in a vector
 * and 1 in a scalar; ?: takes both. */
#define choose(condition, yes, no) ((condition) ? (yes) : (no))

#endif
