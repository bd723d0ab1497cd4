"""Labels of vehicles in the forms that other tools use are read and written here.

Every form becomes labels in pixels of images, or labels on the ground.
"""
