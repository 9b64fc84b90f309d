"""Methods of integration as data: names, Butcher tableaus, one formula each, stability."""

from mbkit.methods.registry import METHODS, Method, method_of, register_method
from mbkit.methods.tableaus import ImplicitTableau, Tableau

__all__ = ["METHODS", "ImplicitTableau", "Method", "Tableau", "method_of", "register_method"]
