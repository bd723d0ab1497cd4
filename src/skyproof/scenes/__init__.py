"""Scenes as plain data. Background sets with their splits and sensors are here, too."""
