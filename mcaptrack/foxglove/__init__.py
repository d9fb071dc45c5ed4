"""Messages and layouts for Foxglove and Lichtblick: pictures, drawings on them and on the ground."""

from mcaptrack.foxglove.annotations import Annotations
from mcaptrack.foxglove.messages import (
    ANNOTATIONS,
    CALIBRATION,
    IMAGE,
    LOG,
    SCENE,
    TRANSFORM,
    VIDEO,
    message_class,
    pack_log,
    pack_picture,
    pack_stamped,
    pack_transform,
    schema_record,
    unpack,
)
from mcaptrack.foxglove.palette import class_colour, colour, colours
from mcaptrack.foxglove.ros import messages_in, record_in
from mcaptrack.foxglove.scenes import CuboidMarker, Cuboids, PersonMarker, SceneMessages
