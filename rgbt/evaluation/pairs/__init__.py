"""Count two frames of every scene together: virtual views, next frames, videos along a flow."""
