"""File formats of logs: text in any encoding, spreadsheets, MATLAB, MCAP; and dates as seconds.

Tables come out; the meaning of their columns is in `signals.importing`.
May import `signals.recording`.
"""
