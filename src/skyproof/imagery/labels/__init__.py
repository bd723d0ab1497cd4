"""Labels of vehicles in the forms that other tools use, in and out."""
