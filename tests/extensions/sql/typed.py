import mcaptrack

listed: mcaptrack.TableList = mcaptrack.list_tables("log.mcap")
tables: list[mcaptrack.TableInfo] = list(listed.tables)
columns: list[mcaptrack.ColumnInfo] = [column for table in tables for column in table.columns]
print(columns, mcaptrack.query("log.mcap", "from tracks").num_rows)
