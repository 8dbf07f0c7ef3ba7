# The mapping service for a machine with an NVIDIA GPU: gsplat draws the map.
#   docker build -f docker/mapping-gpu.Dockerfile -t pointslam/mapping-gpu .
# gsplat compiles its kernels at first use, so the image keeps the CUDA compiler.
FROM nvidia/cuda:13.0.1-devel-ubuntu24.04

ENV OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 OMP_WAIT_POLICY=passive MALLOC_ARENA_MAX=2 \
    MALLOC_MMAP_THRESHOLD_=4194304 \
    PYTHONUNBUFFERED=1
RUN apt-get update && apt-get install -y --no-install-recommends python3 python3-venv python3-dev \
    && rm -rf /var/lib/apt/lists/* && python3 -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH
WORKDIR /app
COPY pyproject.toml README.md requirements.lock ./
COPY shared/ shared/
COPY services/__init__.py services/__init__.py
COPY services/mapping/ services/mapping/
COPY pointslam/__init__.py pointslam/__init__.py
RUN pip install --no-cache-dir -c requirements.lock ".[mapping,cuda]" \
    && useradd --create-home --uid 10001 pointslam \
    && mkdir -p /data && chown pointslam /data /app
USER pointslam
VOLUME /data
HEALTHCHECK --interval=10s --timeout=8s --start-period=60s \
    CMD ["python", "-m", "shared.probe", "mapping", "--connect", "tcp/router:7447"]
ENTRYPOINT ["python", "-m", "services.mapping"]
