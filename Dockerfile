# mcaptrack in an image: what a night's logs need, without torch. The tests check the lines below against the repository;
# tools/installs.py runs the line with `pip install` in an empty environment.
#
#   docker build -t mcaptrack .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" mcaptrack run logs/ --jobs 4 --ledger night.jsonl

FROM python:3.12-slim AS built
WORKDIR /source
COPY pyproject.toml constraints.txt README.md CHANGELOG.md LICENSE ./
COPY docs docs
COPY schemas schemas
COPY mcaptrack mcaptrack
RUN python -m venv /opt/mcaptrack
RUN /opt/mcaptrack/bin/python -m pip install --no-cache-dir -c constraints.txt ".[cloud,fleet]"
# Nothing here runs the tests of packages, Arrow Flight or pip: a sixth of the whole.
RUN find /opt/mcaptrack -type d -name tests -prune -exec rm -r {} +
RUN cd /opt/mcaptrack/lib/python3.*/site-packages/pyarrow && rm -r include libarrow_flight* _flight*
RUN /opt/mcaptrack/bin/python -m pip uninstall --yes pip

FROM python:3.12-slim
COPY --from=built /opt/mcaptrack /opt/mcaptrack
ENV PATH=/opt/mcaptrack/bin:$PATH PYTHONUNBUFFERED=1 XDG_CACHE_HOME=/tmp
RUN useradd --uid 10001 --create-home mcaptrack
USER mcaptrack
WORKDIR /data
HEALTHCHECK --interval=5m --timeout=60s --start-period=30s CMD ["mcaptrack", "doctor", "--quiet"]
ENTRYPOINT ["mcaptrack"]
CMD ["--help"]
