"""Two products: what is made of recordings (`recordings`, `player`), and studies of the methods (`studies`)."""
