"""Real imagery in and out: tiling, labels, removing vehicles."""
