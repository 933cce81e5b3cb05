# docker build -t lslam . && docker run --rm -v "$PWD:/data" lslam run drive.bag --out runs/drive
FROM python:3.11-slim AS build
COPY . /src
RUN python -m venv /opt/lslam && /opt/lslam/bin/pip install --no-cache-dir /src

FROM python:3.11-slim
RUN useradd --create-home lslam
COPY --from=build /opt/lslam /opt/lslam
ENV PATH=/opt/lslam/bin:$PATH
USER lslam
WORKDIR /data
ENTRYPOINT ["lslam"]
