# docker build -t lslam .
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" -v lslam-cache:/cache lslam run drive.bag --out runs/drive
FROM python:3.11-slim AS build
COPY . /src
RUN python -m venv /opt/lslam && /opt/lslam/bin/pip install --no-cache-dir /src

FROM python:3.11-slim
# Compiled kernels lie in the cache, whoever runs it.
RUN useradd --create-home lslam && mkdir -m 1777 /cache
COPY --from=build /opt/lslam /opt/lslam
ENV PATH=/opt/lslam/bin:$PATH XDG_CACHE_HOME=/cache
USER lslam
WORKDIR /data
ENTRYPOINT ["lslam"]
