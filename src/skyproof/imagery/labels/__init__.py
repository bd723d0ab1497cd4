"""Labels of other tools are read. They lie in pixels of images, or on the ground."""
