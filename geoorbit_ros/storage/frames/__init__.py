"""Where images come from: video files, network streams, folders of images."""
