"""Where pixels lie: padded sizes, and the views of a camera that turned (homography, warp)."""
