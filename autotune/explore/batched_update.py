"""One message to the browser for all that a turn changes.

Bokeh sends a message for every property that is set, and the browser draws between them. What changes with every turn
is therefore put into one property of one model, from which a script in the page hands it on.
"""

from collections.abc import Iterable
from typing import Any

from bokeh.core.properties import Any as Anything
from bokeh.core.properties import Dict, String
from bokeh.document import Document
from bokeh.events import DocumentReady
from bokeh.model import DataModel, Model
from bokeh.models import CustomJS

Changes = dict[str, dict[str, Any]]


class Parcel(DataModel):
    """What named models of the page are to hold: for each name, properties and their values."""

    content: Any = Dict(String, Dict(String, Anything), default={})


class Sender:
    """Collect what changes of named models, and send it together.

    Until a browser shows the document the models themselves are set, since they are what it begins with; from then on
    they change in the browser only.
    """

    def __init__(self, document: Document, models: Iterable[Model], carrier: Any) -> None:
        """Prepare to send to `models`; `carrier` is any model of the page, which brings the parcel along."""
        self._models = {str(model.name): model for model in models}
        self._changes: Changes = {}
        self._parcel = Parcel(name="parcel")
        self._parcel.js_on_change("content", CustomJS(code="explore.handOn(cb_obj.content)"))
        self._is_shown = False
        carrier.tags = [self._parcel]
        document.on_event(DocumentReady, self._begin)

    def _begin(self, _event: object) -> None:
        self._is_shown = True

    def put(self, model: Model, **values: Any) -> None:
        """Note properties of one of the models."""
        self._changes.setdefault(str(model.name), {}).update(values)

    def send(self) -> None:
        """Send what was put since the last time."""
        changes, self._changes = self._changes, {}
        if self._is_shown:
            self._parcel.content = changes
            return
        for name, values in changes.items():
            self._models[name].update(**values)
