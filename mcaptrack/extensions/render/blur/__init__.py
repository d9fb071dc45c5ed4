"""Pictures in which people can't be recognised: videos, and logs with replaced pictures.

people      which parts of each picture to hide, from all boxes that a log has, and the pixels that stand there instead
recording   a copy of a log with such pictures, and nothing else changed
"""
