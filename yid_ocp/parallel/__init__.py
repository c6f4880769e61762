"""Parallel work in threads, processes and on cluster workers. Other packages run their long work here."""

from yid_ocp.parallel.resumable_tasks import LOCAL_WORKER_CONFIG as LOCAL_WORKER_CONFIG
from yid_ocp.parallel.resumable_tasks import Task as Task
from yid_ocp.parallel.resumable_tasks import TaskResult as TaskResult
from yid_ocp.parallel.resumable_tasks import WorkerConfig as WorkerConfig
from yid_ocp.parallel.resumable_tasks import require_task_values as require_task_values
from yid_ocp.parallel.resumable_tasks import return_freed_memory as return_freed_memory
from yid_ocp.parallel.resumable_tasks import run_tasks as run_tasks
from yid_ocp.parallel.threads_and_processes import CASADI_LOCK as CASADI_LOCK
from yid_ocp.parallel.threads_and_processes import CasadiLockedCache as CasadiLockedCache
from yid_ocp.parallel.threads_and_processes import CasadiLockedProperty as CasadiLockedProperty
from yid_ocp.parallel.threads_and_processes import InlineExecutor as InlineExecutor
from yid_ocp.parallel.threads_and_processes import call_merged_with_other_threads as call_merged_with_other_threads
from yid_ocp.parallel.threads_and_processes import map_in_threads as map_in_threads
from yid_ocp.parallel.threads_and_processes import map_with_merged_calls as map_with_merged_calls
