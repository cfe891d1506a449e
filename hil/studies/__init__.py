"""Many flights and what is learnt from them."""
