"""Methods of integration as data: names, Butcher tableaus, step control."""
