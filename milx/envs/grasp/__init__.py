"""A hand with two fingers that lifts a thing onto one of three mats."""
