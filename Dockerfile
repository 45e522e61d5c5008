# The program with everything compiled, as a user without privileges, for trying it without installing anything:
#
#   docker build -t cdpr .
#   docker run --rm cdpr                                       # plans, checks, runs and reports on simulated drives
#   docker run --rm -it cdpr bash                              # the commands of docs/getting-started.md
#   docker run --rm -v "$PWD/out:/opt/cdpr/runs" cdpr    # keeps the report; `out` must be writable for user 1000
#
# For drives on a CAN interface of the host it needs more: --network host, --cap-add SYS_NICE, --ulimit rtprio=80,
# --ulimit memlock=-1, on a host with cgroup v1 and RT_GROUP_SCHED also --cpu-rt-runtime=950000 (of dockerd, too), and a
# folder /var/lib/cdpr mounted from the host, where the fault latch outlives the container.
FROM python:3.12-slim

RUN apt-get update \
    && apt-get install -y --no-install-recommends git make \
    && rm -rf /var/lib/apt/lists/*

RUN useradd --create-home --uid 1000 cdpr && install -d -o cdpr -g cdpr /opt/cdpr
USER cdpr
WORKDIR /opt/cdpr

COPY --chown=cdpr:cdpr . .
RUN mkdir -p runs && make install PYTHON=python3.12

ENV PATH="/opt/cdpr/.venv/bin:${PATH}"
CMD ["make", "demo", "PYTHON=python3.12"]
