"""Real imagery is read, cut into tiles and cleared of vehicles. Labels of all forms are read."""
