"""Packets and pixels: video files and image folders in, brightness and colours out, H.264 and JPEG between.

FFmpeg does the work, through PyAV; its wheels bring it along.
"""

from mcaptrack.video.decode import Encoded, brightness, colours
from mcaptrack.video.encode import H264Encoder, Image, ImageFormat, Keep, encode_image, write_clip, write_mp4
from mcaptrack.video.raw import RAW_ENCODINGS, Layout
from mcaptrack.video.source import IMAGE_SUFFIXES, EncodedPicture, Video, open_video, seqinfo_fps
from mcaptrack.video.streams import entry

__all__ = [
    "IMAGE_SUFFIXES",
    "RAW_ENCODINGS",
    "Encoded",
    "EncodedPicture",
    "H264Encoder",
    "Image",
    "ImageFormat",
    "Keep",
    "Layout",
    "Video",
    "brightness",
    "colours",
    "encode_image",
    "entry",
    "open_video",
    "seqinfo_fps",
    "write_clip",
    "write_mp4",
]
