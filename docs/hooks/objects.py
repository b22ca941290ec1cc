"""What reading the sources alone does not tell mkdocstrings of the package."""

from griffe import (
    Alias,
    Class,
    Expr,
    ExprCall,
    Extension,
    Function,
    Module,
    Parameter,
    ParameterKind,
    Parameters,
)

# Marks classes whose `__init__` is made here.
MADE = "module"


class ObjectsExtension(Extension):
    """Functions that stand where their modules did, and signatures of Modules."""

    def on_package(self, *, pkg: Module, **kwargs) -> None:
        _add_inits(pkg)
        # `from .verify import verify` hides the module of that name.
        pkg.set_member("verify", Alias("verify", pkg["verify"]["verify"], parent=pkg))


def _add_inits(parent: Module | Class) -> None:
    for member in list(parent.members.values()):
        if member.is_alias:
            continue
        if member.is_class:
            _add_init(member)
        if member.is_module or member.is_class:
            _add_inits(member)


def _add_init(module: Class) -> None:
    """The `__init__` that Equinox gives to Modules: their fields, as of data classes."""
    family = [module, *module.mro()]
    bases = {str(base) for each in family for base in each.bases}
    written = [each for each in family if "__init__" in each.members]
    if "eqx.Module" not in bases or any(MADE not in each.labels for each in written):
        return
    fields = {
        name: Parameter(
            name,
            annotation=member.annotation,
            kind=ParameterKind.positional_or_keyword,
            default=_default(member.value),
        )
        for each in reversed(family)
        for name, member in each.members.items()
        if member.is_attribute
        and member.annotation is not None
        and "property" not in member.labels
        and "eqx.AbstractVar" not in str(member.annotation)
    }
    self = Parameter("self", kind=ParameterKind.positional_or_keyword)
    parameters = Parameters(self, *fields.values())
    init = Function("__init__", parent=module, parameters=parameters, lineno=0)
    module.set_member("__init__", init)
    module.labels.add(MADE)


def _default(value: str | Expr | None) -> str | Expr | None:
    """What a field is where nothing is given."""
    if not (isinstance(value, ExprCall) and str(value.function) == "eqx.field"):
        return value
    named = {argument.name: argument.value for argument in value.arguments}
    return named.get("default")
