"""Pure tensor mathematics: rotation, the oblique orthophoto projection, normals, colour. Imports torch only."""
