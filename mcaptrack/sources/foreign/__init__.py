"""Adapters for messages of other software: pictures for detectors, and boxes of other detectors.

A message has two times: the log time, which orders everything, and the stamp of its publisher, by which viewers match
drawings to a picture.
"""

from mcaptrack.sources.foreign.boxes import (
    BOXES_READ,
    NamedFrames,
    holds_boxes,
    is_drawing,
    reading_of,
    uncertain_boxes,
)
from mcaptrack.sources.foreign.definitions import MessageType
from mcaptrack.sources.foreign.picture_messages import (
    PICTURES_NOT_READ,
    PICTURES_READ,
    Picture,
    best_form,
    better_form,
    depth_of,
    facts_of,
    holds_pictures,
    is_compressed,
    is_picture,
    picture_decoder,
    picture_reader,
    pictures,
    stamps,
)
