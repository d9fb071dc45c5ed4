"""Read video files and image folders, decode pictures to gray or BGR, and encode H.264, JPEG and PNG.

FFmpeg does the work, through PyAV (its wheels include FFmpeg).
"""

from mcaptrack.sources.video.codecs import is_video_codec, read_head
from mcaptrack.sources.video.decode import RAW_ENCODINGS, EncodedPicture, PixelLayout, decode_bgr, decode_gray
from mcaptrack.sources.video.encode import H264Encoder, VideoOptions, encode_image, write_clip, write_mp4
from mcaptrack.sources.video.image_folder import IMAGE_SUFFIXES, SEQINFO, SeqInfo, find_seqinfo
from mcaptrack.sources.video.reader import PictureMessage, Video, open_video

__all__ = [
    "IMAGE_SUFFIXES",
    "RAW_ENCODINGS",
    "SEQINFO",
    "EncodedPicture",
    "H264Encoder",
    "PictureMessage",
    "PixelLayout",
    "SeqInfo",
    "Video",
    "VideoOptions",
    "decode_bgr",
    "decode_gray",
    "encode_image",
    "find_seqinfo",
    "is_video_codec",
    "open_video",
    "read_head",
    "write_clip",
    "write_mp4",
]
