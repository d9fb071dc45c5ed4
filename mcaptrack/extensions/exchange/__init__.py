"""The boxes of a channel as files of annotation tools and benchmarks: KITTI, COCO, CVAT, and a plain table."""
