"""The method of Paper II, its full-Moon scheme and its laboratory bench, beside the joint model."""
