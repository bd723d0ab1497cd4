"""The differentiable renderer: rasterise, shade, average, blur, lay over the photograph; datasets and close-ups."""
