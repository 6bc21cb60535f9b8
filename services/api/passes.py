"""With which rights a request goes on behind the gate."""

from dataclasses import dataclass

from starlette.types import Scope

from services.storage.tokens import Role

_KEY = "deltalight.pass"


@dataclass(frozen=True)
class Pass:
    """`token_id` is None where no token was needed."""

    role: Role
    token_id: str | None = None
    name: str = ""


def give_pass(scope: Scope, rights: Pass) -> None:
    """Note the rights of a request."""
    scope[_KEY] = rights


def pass_of(scope: Scope) -> Pass:
    """The rights with which a request came through the gate."""
    rights = scope[_KEY]
    assert isinstance(rights, Pass)
    return rights
