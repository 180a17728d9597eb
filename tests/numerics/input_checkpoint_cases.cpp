// G09 to G11 and G18: checkpoints that lie, and disks that are full.
#include <signal.h>
#include <sys/resource.h>

#include <algorithm>
#include <cstring>

#include "box_room.h"
#include "core/rng.h"
#include "input_parts.h"
#include "run/run_folder.h"
#include "session/trainer.h"
#include "system/files.h"
#include "tests/scene/room_files.h"

namespace semfield::numerics {

namespace {

// A real checkpoint of a small network in three steps: parameters, moments, a resolved configuration.
std::string small_checkpoint(const Registry& known) {
  Registry registry = with_room(known);
  Session session = open_room(
      "scene: {type: box_room}\nrendering: {density_activation: softplus}\npasses:\n"
      "  - sampler: {type: stratified, samples: 4}\n    position: {type: frequency, frequencies: 1}\n"
      "    direction: {type: spherical_harmonics, degree: 1}\n"
      "    field: {type: tiny_mlp, hidden_width: 8, color_width: 8, color_layers: 1}\ntrain: {rays: 16}\n",
      registry);
  const auto rays = session.make_ray_source();
  Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule);
  for (int step = 0; step < 3; ++step) trainer.advance();
  return encode_safetensors(trainer.state(), {{"format", "semfield-checkpoint-1"},
                                              {"config", write_config(resolved_config(session.config))}});
}

bool refused_as_data(const std::string& bytes) {
  try {
    (void)TensorFile::decode(bytes, "checkpoint", {});
  } catch (const Error& error) {
    return error.kind() == ErrorKind::data && !error.remedy().empty();
  }
  return false;
}

std::string with_header(const std::string& header, std::size_t data_bytes) {
  std::string file(8, '\0');
  const std::uint64_t length = header.size();
  std::memcpy(file.data(), &length, 8);
  return file + header + std::string(data_bytes, '\0');
}

void save(CheckpointStore& store, std::int64_t step, std::size_t values = 2000) {
  const std::vector<float> data(values, static_cast<float>(step));
  store.save(step, {tensor_ref("w", {static_cast<std::int64_t>(values)}, data)}, {});
}

// Lowers one limit of the process while it lives.
class LowLimit {
 public:
  LowLimit(int what, rlim_t value) : what_(what) {
    ::getrlimit(static_cast<__rlimit_resource>(what_), &before_);
    const rlimit low{std::min(value, before_.rlim_max), before_.rlim_max};
    ::setrlimit(static_cast<__rlimit_resource>(what_), &low);
    handler_ = ::signal(SIGXFSZ, SIG_IGN);  // a write beyond the limit then fails instead of ending the process
  }
  ~LowLimit() {
    ::setrlimit(static_cast<__rlimit_resource>(what_), &before_);
    ::signal(SIGXFSZ, handler_);
  }
  LowLimit(const LowLimit&) = delete;
  LowLimit& operator=(const LowLimit&) = delete;

 private:
  int what_;
  rlimit before_{};
  sighandler_t handler_ = SIG_DFL;
};

}  // namespace

void checkpoint_flips(CaseRun& run) {
  run.row("-");
  const std::string good = small_checkpoint(run.registry());
  (void)TensorFile::decode(good, "checkpoint", {});
  const std::size_t bits = 8 * good.size();
  const int flips = 10'000;
  int accepted = 0;
  for (int i = 0; i < flips; ++i) {
    // Evenly over the file, at a random place of each part: header, metadata and every tensor get their part.
    const auto part = static_cast<std::size_t>(i) * bits / flips, next = static_cast<std::size_t>(i + 1) * bits / flips;
    const std::size_t bit = part + uniform_below({3, 0, stream_id("stiff flip")}, static_cast<std::uint64_t>(i),
                                                 std::max<std::size_t>(1, next - part));
    std::string bad = good;
    bad[bit / 8] = static_cast<char>(bad[bit / 8] ^ (1 << (bit % 8)));
    accepted += refused_as_data(bad) ? 0 : 1;
  }
  run.measure(accepted, 0, "flips accepted");
  run.note(std::to_string(flips) + " flips over " + std::to_string(good.size()) +
           " bytes of a trained network's checkpoint");
}

void checkpoint_cuts(CaseRun& run) {
  run.row("-");
  const std::string good = small_checkpoint(run.registry());
  int accepted = 0;
  for (std::size_t i = 0; i < 1000; ++i) accepted += refused_as_data(good.substr(0, i * good.size() / 1000)) ? 0 : 1;
  accepted += refused_as_data(good.substr(0, good.size() - 1)) ? 0 : 1;
  accepted += refused_as_data(good + '\0') ? 0 : 1;
  run.measure(accepted, 0, "lengths accepted");
  // On the disk: the newest one cut short, the one before is found and the damage is reported.
  CheckpointStore store(run.folder() + "/c");
  save(store, 100);
  save(store, 200);
  const std::string newest = run.folder() + "/c/" + CheckpointStore::file_name(200);
  const std::string whole = read_text_file(newest);
  for (const std::size_t size :
       {whole.size() - 1, whole.size() / 2, std::size_t{300}, std::size_t{8}, std::size_t{0}}) {
    testing_room::plain_write(newest, whole.substr(0, size));
    Diagnostics found;
    const auto latest = store.find_latest(found);
    run.expect(latest && latest->step == 100 && latest->file.floats("w", 2000)[0] == 100.0F, "step 100 is used");
    run.expect(told(found, Severity::warning, CheckpointStore::file_name(200)), "and the damaged file named");
  }
  testing_room::plain_write(run.folder() + "/c/" + CheckpointStore::file_name(100), whole.substr(0, 40));
  run.expect_error(ErrorKind::data, {"none of the 2 checkpoints"}, [&] {
    Diagnostics found;
    (void)store.find_latest(found);
  });
}

void checkpoint_shapes(CaseRun& run) {
  run.row("-");
  TensorFile::Limits no_sums{.require_checksums = false};
  const auto decode = [&](const std::string& file) { (void)TensorFile::decode(file, "hostile.safetensors", no_sums); };
  decode(with_header(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}})", 8));  // the control
  const struct {
    std::string header;
    std::size_t data;
    const char* words;
  } kHostile[] = {
      {R"({"a":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,0]}})", 0,
       "product of its shape overflows"},
      {R"({"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,0]}})", 0,
       "product of its shape overflows"},
      {R"({"a":{"dtype":"F32","shape":[9223372036854775808],"data_offsets":[0,0]}})", 0, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[0,9223372036854775807,9223372036854775807],"data_offsets":[0,0]}})", 0,
       "not a count"},
      {R"({"a":{"dtype":"F32","shape":[1152921504606846976],"data_offsets":[0,4611686018427387904]}})", 0, "cut short"},
      {R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"b":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}})",
       12, "overlapping"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"b":{"dtype":"F32","shape":[1],"data_offsets":[8,12]}})",
       12, "a hole after byte 4"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[4,8]}})", 8, "a hole after byte 0"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"a":{"dtype":"F32","shape":[1],"data_offsets":[4,8]}})",
       8, "'a' stands twice"},
      {R"({"a":{"dtype":"F32","dtype":"F64","shape":[1],"data_offsets":[0,4]}})", 4, "'dtype' stands twice"},
      {R"({"a":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}})", 4, "dtype 'BF16'"},
      {R"({"a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}})", 4, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[1e0],"data_offsets":[0,4]}})", 4, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[4,0]}})", 4, "do not hold"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,9223372036854775808]}})", 4, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":["x",0]}})", 4, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[3],"data_offsets":[0,8]}})", 8, "do not hold"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}})", 5, "1 bytes behind the last tensor"},
      {R"({"__metadata__":{"a":1}})", 0, "not a text"},
      {R"([])", 0, "not a JSON object"},
      {R"({"a":)", 0, "not JSON"},
      {std::string(1'000'000, '['), 0, "nested too deeply"},
  };
  for (const auto& bad : kHostile)
    run.expect_error(ErrorKind::data, {"hostile.safetensors", bad.words},
                     [&] { decode(with_header(bad.header, bad.data)); });
  const ResourceUse use;
  for (const std::uint64_t length :
       {std::uint64_t{100'000'001}, std::uint64_t{1} << 62, ~std::uint64_t{0}, std::uint64_t{99'000'000}}) {
    std::string file = with_header("{}", 0);
    std::memcpy(file.data(), &length, 8);
    run.expect_error(ErrorKind::data, {"header length", "exceeds"}, [&] { decode(file); });
  }
  run.expect(use.grown_mib() < 16, "a stated length allocates nothing");
  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    const std::vector<float> values{0, bad};
    const std::string file = encode_safetensors({tensor_ref("w", {2}, values)}, {});
    run.expect_error(ErrorKind::data, {"tensor 'w' holds NaN or infinity"}, [&] { decode(file); });
    const std::vector<double> wide{static_cast<double>(bad)};
    run.expect_error(ErrorKind::data, {"tensor 'v' holds NaN or infinity"},
                     [&] { decode(encode_safetensors({tensor_ref("v", {1}, wide)}, {})); });
  }
  run.expect_error(ErrorKind::data, {"no checksum"},
                   [&] { (void)TensorFile::decode(with_header("{}", 0), "bare", {}); });
}

void full_disk(CaseRun& run) {
  run.row("-");
  run.note("limits of the process stand for the disk: no room from byte n on, no handle from the n-th on");
  const std::string folder = run.folder() + "/c";
  CheckpointStore store(folder);
  save(store, 100);
  const std::size_t size = std::filesystem::file_size(folder + "/" + CheckpointStore::file_name(100));
  int failed = 0;
  const auto old_is_intact = [&] {
    Diagnostics found;
    const auto latest = store.find_latest(found);
    run.expect(latest && latest->step == 100 && latest->file.floats("w", 2000)[1] == 100.0F && found.all().empty(),
               "step 100 is intact and newest");
    run.expect(read_text_file(folder + "/latest") == CheckpointStore::file_name(100) + "\n", "'latest' names it");
    for (const auto& entry : std::filesystem::directory_iterator(folder))
      run.expect(entry.path().extension() != ".tmp", "no temporary file stays");
  };
  for (const std::size_t room : {std::size_t{0}, std::size_t{1}, std::size_t{4096}, size / 2, size - 1}) {
    {
      const LowLimit limit(RLIMIT_FSIZE, room);
      run.expect_error(ErrorKind::io, {"the checkpoint of step 100 is kept"}, [&] { save(store, 200); });
    }
    ++failed;
    old_is_intact();
  }
  // The lowest free handle, then 0, 1, 2 ... handles more than there are open ones.
  const int free_handle = [] {
    std::FILE* file = std::fopen("/dev/null", "r");
    const int number = file == nullptr ? 16 : ::fileno(file);
    if (file != nullptr) std::fclose(file);
    return number;
  }();
  bool saved = false;
  for (int more = 0; more < 4 && !saved; ++more) {
    bool threw = false;
    {
      const LowLimit limit(RLIMIT_NOFILE, static_cast<rlim_t>(free_handle + more));
      try {
        save(store, 200);
        saved = true;
      } catch (const Error& error) {
        threw = true;
        run.expect(error.kind() == ErrorKind::io, std::string("kind of: ") + error.what());
        run.expect(std::string_view(error.what()).find("Too many open files") != std::string_view::npos,
                   std::string("the cause is named: ") + error.what());
      }
    }
    if (threw) ++failed;
    if (threw) old_is_intact();
  }
  run.expect(saved, "with enough handles it saves");
  Diagnostics found;
  run.expect(store.find_latest(found)->step == 200, "and the new one is then newest");
  // A folder in the place of the file: root meets that too.
  std::filesystem::create_directories(folder + "/" + CheckpointStore::file_name(300) + "/x");
  run.expect_error(ErrorKind::io, {"the checkpoint of step 200 is kept"}, [&] { save(store, 300); });
  run.expect(store.find_latest(found)->step == 200, "step 200 is intact");
  run.note(std::to_string(failed + 1) + " failed saves");
}

}  // namespace semfield::numerics
