"""Pure tensor mathematics: rotations, the oblique orthophoto projection, normals, boxes, colour. Imports torch only."""
