"""Pictures of frames and programs, as SVG and as text for other tools, without any of them."""
