"""3D boxes of label files: tables, KITTI tracking, nuScenes and Argoverse 2."""
