"""Pictures in which people can't be recognised: videos, and logs with replaced pictures.

people      which parts of each picture to hide, from all boxes that a log has
in_space    3D boxes of people, projected into the pictures of calibrated cameras
pieces      where people are between two rows of their track, and around it
classes     which classes of objects show people
mosaic      the pixels that stand there instead
recording   a copy of a log with such pictures, and nothing else changed
"""
