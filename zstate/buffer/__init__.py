"""Where things were: histories of joints and poses, and exact answers at any stamp of them."""
