"""The commands behind `jaxscp.__main__`."""
