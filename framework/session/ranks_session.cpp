#include "session/ranks_session.h"

#include <sched.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "execution/ranks_executor.h"
#include "session/manifest_text.h"

namespace semfield {

namespace {

// What rank 0 tells before the texts and numbers that a network is made of; no config: there will be no session.
struct Building {
  std::uint64_t config = 0, manifest = 0, weights = 0;  // bytes, bytes, numbers
  std::int32_t trainable = 0, cuda = 0, ordinal = 0;
};

template <class T>
std::span<std::byte> bytes_of(T& values) {
  return std::as_writable_bytes(std::span(values));
}

void broadcast(Ranks& ranks, Building& building) { ranks.broadcast(std::as_writable_bytes(std::span(&building, 1))); }

int cuda_devices() {
  int count = 0;
  while (cuda_available(nullptr, count)) ++count;
  return count;
}

// Ranks of a host take its devices in turn, from the one that was asked for on.
DeviceId device_of(const Ranks& ranks, DeviceId asked) {
  if (asked.kind == Device::cpu) return asked;
  const int count = cuda_devices();
  if (count == 0) {
    std::string why_not;
    (void)cuda_available(&why_not, asked.ordinal);
    throw Error(ErrorKind::unavailable, "device.gpu.unavailable",
                ranks.name_of(ranks.rank()) + ": runtime.device: cuda: " + why_not, "set runtime.device: cpu");
  }
  return {asked.kind, (asked.ordinal + ranks.local_rank()) % count};
}

// The network of rank 0's session, without its scene.
struct Follower {
  RunConfig config;
  BuildPlan plan;
  SceneExtent extent;
  std::unique_ptr<Pipeline<float>> pipeline;
  DeviceId device;
};

Follower assemble_follower(Ranks& ranks, Registry& registry, const Building& building, const std::string& config,
                           const std::string& manifest, std::vector<float> class_weight) {
  Follower made;
  made.config = run_config_of(parse_config_text(config, "the configuration of rank 0"), registry);
  const KnownScene known = *read_manifest_text({{"scene", manifest}});
  made.device = device_of(ranks, {building.cuda != 0 ? Device::cuda : Device::cpu, building.ordinal});
  if (made.device.kind != Device::cpu) add_cuda_kernels(registry);
  made.extent = extent_of(made.config, known.pixel_footprint_m);
  std::unique_ptr<Sampler<float>> last = make_last_sampler(made.config, registry, made.extent);
  BuildRequest request = build_request(made.config, registry, last->traits());
  request.no_cuda.clear();
  made.plan = plan_build(known.manifest, request, made.config.runtime.keep);
  made.pipeline = assemble(make_parts<float>(made.config, registry, made.plan, made.extent, std::move(last)),
                           std::move(class_weight), building.trainable != 0);
  return made;
}

void serve_session(Ranks& ranks, Registry& registry, const Building& building) {
  std::string config(building.config, '\0'), manifest(building.manifest, '\0');
  std::vector<float> class_weight(building.weights);
  ranks.broadcast(bytes_of(config));
  ranks.broadcast(bytes_of(manifest));
  ranks.broadcast(bytes_of(class_weight));
  Follower made;
  try {
    agree(ranks, [&] { made = assemble_follower(ranks, registry, building, config, manifest, class_weight); });
    agree(ranks, [&] {
      run_on({made.device, building.trainable != 0, &ranks}, made.config, registry, made.plan, made.extent,
             *made.pipeline);
    });
  } catch (const RankLost&) {
    throw;
  } catch (const Error&) {  // rank 0 throws it too
    return;
  }
  WorkSettings work = made.pipeline->options().work;
  work.limits = &made.config.limits;
  const WorkScope scope(work);
  static_cast<RanksExecutor&>(made.pipeline->executor()).serve();
}

}  // namespace

void lead(Ranks& ranks, Session& session, Registry& registry, RunOn how) {
  std::string config = write_config(resolved_config(session.config));
  std::string manifest = manifest_text({session.manifest, session.scene.pixel_footprint_m});
  std::vector<float> class_weight = session.pipeline->options().class_weight;
  Building building{config.size(),
                    manifest.size(),
                    class_weight.size(),
                    how.trainable ? 1 : 0,
                    how.device.kind != Device::cpu ? 1 : 0,
                    how.device.ordinal};
  broadcast(ranks, building);
  ranks.broadcast(bytes_of(config));
  ranks.broadcast(bytes_of(manifest));
  ranks.broadcast(bytes_of(class_weight));
  agree(ranks, [&] { how.device = device_of(ranks, how.device); });
  how.ranks = &ranks;
  agree(ranks, [&] { run_on(how, session.config, registry, session.plan, session.extent, *session.pipeline); });
}

void follow(Ranks& ranks, Registry& registry) {
  for (;;) {
    Building building;
    broadcast(ranks, building);
    if (building.config == 0) return;
    serve_session(ranks, registry, building);
  }
}

void dismiss(Ranks& ranks) {
  Building none;
  broadcast(ranks, none);
}

std::string prepare_ranks(Ranks& ranks, const std::string& version) {
  const std::vector<std::string> versions = texts_of(ranks, version);
  const std::vector<std::string> sets = texts_of(ranks, std::string(isa_name(isa())));
  for (int r = 1; r < ranks.size(); ++r) {
    const auto i = static_cast<std::size_t>(r);
    if (versions[i] != versions[0])
      throw Error(ErrorKind::unavailable, "ranks.version.differs",
                  ranks.name_of(r) + " runs " + versions[i] + ", and " + ranks.name_of(0) + " " + versions[0],
                  "install the same version on all hosts");
    if (sets[i] != sets[0])
      throw Error(
          ErrorKind::unavailable, "ranks.isa.differs",
          ranks.name_of(r) + " computes with " + sets[i] + " instructions, and " + ranks.name_of(0) + " with " +
              sets[0] + ": their results would differ in the last bits",
          "set the environment variable SEMFIELD_ISA to the weaker of both for all ranks (mpirun -x SEMFIELD_ISA=" +
              std::min(sets[i], sets[0]) + ")");
  }
  cpu_set_t own;
  CPU_ZERO(&own);
  (void)sched_getaffinity(0, sizeof own, &own);
  const std::vector<cpu_set_t> all = all_of(ranks, own);
  const auto host = [&](int r) { return ranks.name_of(r).substr(ranks.name_of(r).rfind(' ')); };
  int together = 0;
  for (int r = 0; r < ranks.size(); ++r) {
    if (host(r) == host(ranks.rank()) && CPU_EQUAL(&all[static_cast<std::size_t>(r)], &own)) ++together;
  }
  const int threads = std::max(1, hardware_threads() / std::max(1, together));
  set_thread_count(threads);
  const auto cores = static_cast<int>(sysconf(_SC_NPROCESSORS_ONLN));
  std::string text = std::to_string(ranks.size()) + " processes, " + std::to_string(ranks.local_size()) +
                     " of them on this host, each with " + std::to_string(threads) +
                     (threads == 1 ? " thread" : " threads") + " by default";
  // Launchers bind processes to cores, Open MPI to a single one where there are two processes.
  if (CPU_COUNT(&own) < cores && threads * ranks.local_size() < cores)
    text += ": the launcher lets it use " + std::to_string(CPU_COUNT(&own)) + " of " + std::to_string(cores) +
            " cores (mpirun --bind-to none: all)";
  return text;
}

}  // namespace semfield
