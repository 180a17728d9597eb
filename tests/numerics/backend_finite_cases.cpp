// I07: the checks for NaN and infinity are alive in the build that is shipped.
#include <dlfcn.h>

#include <algorithm>

#include "backend_parts.h"
#include "box_room.h"
#include "compute/math_functions.h"
#include "datasets/obj_room/mesh_io.h"
#include "datasets/obj_room/raycast.h"
#include "eval/metrics.h"
#include "model/compositor.h"
#include "model/optim/adam.h"
#include "scene/classes/class_table.h"
#include "scene/scene_checks.h"
#include "session/trainer.h"
#include "surface/mesh/marching_cubes.h"
#include "system/checksum.h"
#include "system/files.h"
#include "tests/model_compositor/rays_of_slabs.h"
#include "tests/scene/room_files.h"

namespace semfield::numerics {

namespace {

// A word of the compiler's command line that removes such checks, "" for none.
std::string banned_flag(const std::string& commands) {
  for (const char* flag : {"-ffast-math", "-Ofast", "-ffinite-math-only", "-fno-honor-nans", "-menable-no-nans",
                           "-funsafe-math-optimizations", "--use_fast_math", "-ffp-model=fast", "-fassociative-math"}) {
    if (commands.find(flag) != std::string::npos) return flag;
  }
  return {};
}

// compile_commands.json in a folder above this library: the build's own record of how each file was compiled.
std::string compile_commands() {
  Dl_info info{};
  if (dladdr(reinterpret_cast<const void*>(&compile_commands), &info) == 0 || info.dli_fname == nullptr) return {};
  std::error_code ignored;
  std::filesystem::path folder = std::filesystem::absolute(info.dli_fname, ignored).parent_path();
  for (int up = 0; up < 4 && !folder.empty(); ++up, folder = folder.parent_path()) {
    if (std::filesystem::is_regular_file(folder / "compile_commands.json", ignored))
      return read_text_file((folder / "compile_commands.json").string());
  }
  return {};
}

template <class Real>
void kernel_guards(CaseRun& run) {
  const Real nan = std::numeric_limits<Real>::quiet_NaN(), inf = std::numeric_limits<Real>::infinity();
  for (const Real bad : {nan, -nan, inf, -inf, std::numeric_limits<Real>::signaling_NaN()}) {
    std::vector<Real> values(100, Real(1));
    run.expect(all_finite(values.data(), 100) && first_non_finite<Real>({values.data(), 10, 10}) == -1,
               "sound numbers pass");
    values[63] = bad;
    run.expect(!all_finite(values.data(), 100), "all_finite sees it");
    run.expect(first_non_finite<Real>({values.data(), 10, 10}) == 63, "first_non_finite finds it");
    for (const IsaTable<Real>& table : isa_tables<Real>())
      run.expect(!table.kernels.all_finite(values.data(), 100), "all_finite on " + std::string(isa_name(table.isa)));
    testing::RayBuffers<Real> rays({3, 5}, 0);
    std::fill(rays.sigma.begin(), rays.sigma.end(), Real(1));
    check_density(rays.samples, View<const Real>(rays.col(rays.sigma)));
    rays.sigma[5] = bad;
    run.expect_error(ErrorKind::failure, {"ray 1", "sample 2"},
                     [&] { check_density(rays.samples, View<const Real>(rays.col(rays.sigma))); });
  }
}

// Every dense tensor in turn gets one NaN: the step says so and changes nothing.
void trainer_guards(CaseRun& run) {
  Registry registry = with_room(run.registry());
  Session session = open_room(std::string("scene: {type: box_room}\n") + kHashPass, registry);
  const auto rays = session.make_ray_source();
  int poisoned = 0;
  for (std::size_t i = 0; i < session.pipeline->store().all().size(); ++i) {
    // A network of its own for each: a run ends with such a step.
    session.pipeline = assemble<float>(session.config, registry, session.plan, session.extent, {}, true);
    Tensor<float>& t = session.pipeline->store().all()[i];
    if (!t.learned() || t.spec.role == TensorRole::sparse) continue;
    Trainer trainer(*session.pipeline, *rays, session.config.adam, session.config.schedule);
    trainer.advance();
    t.value.data()[0] = std::numeric_limits<float>::quiet_NaN();
    session.pipeline->derive(trainer.step());
    const auto state = [&] {
      std::uint32_t crc = 0;
      for (const TensorRef& tensor : trainer.state()) crc = crc32c(tensor.bytes, crc);
      return crc;
    };
    const std::uint32_t before = state();
    run.expect_error(ErrorKind::failure, {}, [&] { trainer.advance(); });
    run.expect(state() == before && trainer.step() == 1, "the step changed nothing: " + t.name);
    ++poisoned;
  }
  run.expect(poisoned > 5, "tensors were poisoned");
  run.note(std::to_string(poisoned) + " tensors of a network, each with a NaN");
}

}  // namespace

void finite_checks(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) { kernel_guards<Real>(run); });
  run.row("-");
#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
  run.expect(false, "this build assumes that numbers are finite");
#endif
  const std::string commands = compile_commands();
  if (commands.empty()) {
    run.note("no compile_commands.json above this library: its flags were not read");
  } else {
    run.expect(banned_flag(commands).empty(), "a flag of the fast-math family: " + banned_flag(commands));
    run.expect(!banned_flag("c++ -O3 -ffast-math -c a.cpp").empty(), "the search finds such a flag");
  }
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto bad = static_cast<float>(nan);
  Diagnostics quiet;
  Pose pose;
  pose.r[1][2] = nan;
  run.expect(check_pose(pose, "x", quiet) == PoseState::not_finite, "poses");
  Camera camera{4, 4, 4, 4, 2, 2};
  run.expect(check_camera(camera, "x", quiet), "a sound camera passes");
  camera.k2 = nan;
  run.expect(!check_camera(camera, "x", quiet), "cameras");
  ColorError color;
  color.add(std::vector<float>{1}, std::vector<float>{bad});
  DepthError depth;
  depth.add(std::vector<float>{1}, std::vector<float>{bad});
  Calibration calibration;
  calibration.add(std::vector<float>{bad, 0.5F}, 2, std::vector<std::int16_t>{0});
  run.expect(color.nonfinite() == 1 && depth.nonfinite() == 1 && calibration.nonfinite() == 1, "metrics");
  SoftMap soft(2, 2);
  run.expect_error(ErrorKind::data, {}, [&] { soft.set_row(1, std::vector<float>{0.5F, bad}); });
  const std::vector<float> weights{1, bad};
  run.expect_error(ErrorKind::data, {"holds NaN"},
                   [&] { (void)TensorFile::decode(encode_safetensors({tensor_ref("w", {2}, weights)}, {}), "f", {}); });
  run.expect_error(ErrorKind::data, {"not a number"}, [&] {
    (void)marching_cubes({{0, 0, 0}, 1, 2, 2, 2}, 0.5,
                         [&](std::int64_t, std::span<double> values) { std::fill(values.begin(), values.end(), nan); });
  });
  if (raycast_available()) {
    const std::string path = run.folder() + "/nan.obj";
    testing_room::plain_write(path, "v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n");
    run.expect_error(ErrorKind::data, {"not a finite number"}, [&] { (void)load_obj(path, quiet); });
  }
  Registry registry = with_room(run.registry());
  run.expect_error(ErrorKind::config, {".nan"}, [&] {
    (void)open_room(std::string("scene: {type: box_room}\n") + kHashPass + "report: {eval_every_s: .nan}\n", registry);
  });
  trainer_guards(run);
}

}  // namespace semfield::numerics
