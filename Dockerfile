# autotune with all extras. Results are written to the mounted folder:
#   docker build -t autotune .
#   docker run --rm -v "$PWD:/work" autotune identify run7.mcap
FROM python:3.11-slim AS build
# `--build-arg EXTRAS=all,dask` for the hosts of a campaign.
ARG EXTRAS=all
COPY . /source
RUN python -m venv /opt/autotune && /opt/autotune/bin/pip install --no-cache-dir "/source[${EXTRAS}]"
# Compiled here, so that no run in a container compiles anew.
RUN /opt/autotune/bin/autotune warm --quiet

FROM python:3.11-slim
COPY --from=build /opt/autotune /opt/autotune
# The folder of the results belongs to whoever mounts it: `--user "$(id -u):$(id -g)"` writes as them.
RUN useradd --create-home --uid 1000 autotune
USER 1000
WORKDIR /work
ENTRYPOINT ["/opt/autotune/bin/autotune"]
CMD ["--help"]
