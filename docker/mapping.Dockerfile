# The mapping service alone: only its own code and shared/ are in the image.
#   docker build -f docker/mapping.Dockerfile -t pointslam/mapping .
FROM python:3.11-slim

ENV OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OMP_WAIT_POLICY=passive MALLOC_ARENA_MAX=2 \
    MALLOC_MMAP_THRESHOLD_=4194304 \
    PYTHONUNBUFFERED=1
WORKDIR /app
COPY pyproject.toml README.md requirements.lock ./
COPY shared/ shared/
COPY services/__init__.py services/__init__.py
COPY services/mapping/ services/mapping/
COPY pointslam/__init__.py pointslam/__init__.py
RUN pip install --no-cache-dir -c requirements.lock ".[mapping]" \
    && useradd --create-home --uid 10001 pointslam \
    && mkdir -p /data && chown pointslam /data /app
USER pointslam
VOLUME /data
HEALTHCHECK --interval=10s --timeout=8s --start-period=60s \
    CMD ["python", "-m", "shared.probe", "mapping", "--connect", "tcp/router:7447"]
ENTRYPOINT ["python", "-m", "services.mapping"]
