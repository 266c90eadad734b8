"""Is this record fit to be judged? Levels of the channels, and faults that need no model of the rig."""

from .clipping import clipping_level, clipping_text
from .findings import ChannelSummary, RecordFinding, RecordSurvey
from .survey import survey_record

__all__ = ["ChannelSummary", "RecordFinding", "RecordSurvey", "clipping_level", "clipping_text", "survey_record"]
