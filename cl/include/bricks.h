/* Bricks of 8 x 8 x 8 voxels, and the comparison of their values with an iso value. */
#ifndef CLRECON_BRICKS_H
#define CLRECON_BRICKS_H

#define BRICK 8

#define BRICK_OUTSIDE 0
#define BRICK_INSIDE 1
#define BRICK_MIXED 2

#endif
