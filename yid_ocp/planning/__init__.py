"""Planning of robot motions with the identified model."""
