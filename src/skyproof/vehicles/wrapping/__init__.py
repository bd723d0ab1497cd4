"""Real meshes on the shared template: read, turned, laid around, baked, judged."""
