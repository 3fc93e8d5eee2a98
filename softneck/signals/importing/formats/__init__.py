"""What foreign files hold: text in any encoding, spreadsheets, MATLAB, MCAP; and dates as seconds.

Tables come out; what their columns mean is told in the room above.
May import `signals.recording`.
"""
