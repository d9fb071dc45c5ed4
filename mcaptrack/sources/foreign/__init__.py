"""Adapters for messages of other software: pictures for detectors, and boxes of other detectors.

A message has two times: the log time, which orders everything, and the stamp of its publisher, by which viewers match
drawings to a picture.
"""

from mcaptrack.sources.foreign.boxes import BOXES_READ as BOXES_READ
from mcaptrack.sources.foreign.boxes import NamedFrames as NamedFrames
from mcaptrack.sources.foreign.boxes import holds_boxes as holds_boxes
from mcaptrack.sources.foreign.boxes import is_drawing as is_drawing
from mcaptrack.sources.foreign.boxes import reading_of as reading_of
from mcaptrack.sources.foreign.boxes import uncertain_boxes as uncertain_boxes
from mcaptrack.sources.foreign.definitions import MessageType as MessageType
from mcaptrack.sources.foreign.picture_messages import PICTURES_NOT_READ as PICTURES_NOT_READ
from mcaptrack.sources.foreign.picture_messages import PICTURES_READ as PICTURES_READ
from mcaptrack.sources.foreign.picture_messages import Picture as Picture
from mcaptrack.sources.foreign.picture_messages import best_form as best_form
from mcaptrack.sources.foreign.picture_messages import better_form as better_form
from mcaptrack.sources.foreign.picture_messages import depth_of as depth_of
from mcaptrack.sources.foreign.picture_messages import facts_of as facts_of
from mcaptrack.sources.foreign.picture_messages import holds_pictures as holds_pictures
from mcaptrack.sources.foreign.picture_messages import is_compressed as is_compressed
from mcaptrack.sources.foreign.picture_messages import is_picture as is_picture
from mcaptrack.sources.foreign.picture_messages import picture_decoder as picture_decoder
from mcaptrack.sources.foreign.picture_messages import picture_reader as picture_reader
from mcaptrack.sources.foreign.picture_messages import pictures as pictures
from mcaptrack.sources.foreign.picture_messages import stamps as stamps

__all__ = ["Picture", "holds_boxes", "holds_pictures", "is_compressed", "picture_reader", "pictures"]
