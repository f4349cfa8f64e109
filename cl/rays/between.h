/* With -D BETWEEN: rays that count only between two depths of each pixel, see cl/rays/layers.cl. */
#ifndef CLRECON_BETWEEN_H
#define CLRECON_BETWEEN_H

#ifdef BETWEEN
#define BETWEEN_PARAMETERS , __global const float *restrict nearest, __global const float *restrict farthest
#define BETWEEN_ARGUMENTS , nearest, farthest
#else
#define BETWEEN_PARAMETERS
#define BETWEEN_ARGUMENTS
#endif

#endif
