"""Operations on images and flows: warping, local correlation, derivatives, pyramids."""
