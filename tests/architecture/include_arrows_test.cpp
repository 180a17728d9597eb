// Every include of the house keeps to the floors; the rules themselves are tried on known violations.
#include <gtest/gtest.h>

#include "tests/architecture/include_rules.h"

namespace semfield::architecture {
namespace {

const std::vector<std::string> kSources{".h", ".cpp", ".cu", ".cuh"};

void check_folder(const std::string& folder, std::size_t at_least) {
  std::size_t count = 0;
  for (const SourceFile& file : files_under(folder, kSources)) {
    for (const Include& include : includes_of(file.text)) {
      ++count;
      const std::string why = why_forbidden(file.path, include.target);
      EXPECT_EQ(why, "") << file.path << ":" << include.line << " includes " << include.target;
    }
  }
  EXPECT_GE(count, at_least) << "hardly any include was read under " << folder;
}

TEST(IncludeArrows, FrameworkKeepsItsFloors) { check_folder("framework", 100); }
TEST(IncludeArrows, PluginsSeeTheSdkAlone) { check_folder("plugins", 50); }
TEST(IncludeArrows, TheApplicationStandsOnTop) { check_folder("app", 1); }
TEST(IncludeArrows, TestsKeepTheLibrariesApart) {
  check_folder("tests", 20);
}

struct Arrow {
  const char* path;
  const char* target;
};

TEST(IncludeRules, KnownViolationsAreForbidden) {
  const Arrow violations[] = {
      {"framework/core/view.h", "config/params.h"},
      {"framework/core/view.h", "plugin/encoder.h"},
      {"framework/core/view.h", "system/files.h"},
      {"framework/system/files.cpp", "compute/parallel.h"},
      {"framework/config/params.h", "scene/scene.h"},
      {"framework/formats/npz.cpp", "scene/classes/soft_map.h"},
      {"framework/scene/classes/class_table.h", "scene/scene.h"},
      {"framework/scene/scene.h", "scene/survey/geometry_survey.h"},
      {"framework/scene/survey/geometry_survey.h", "loading/frame_source.h"},
      {"framework/plugin/dataset.h", "loading/frame_source.h"},
      {"plugins/label_readers/clicks/clicks.cpp", "eval/evaluator.h"},
      {"framework/config/compose.cpp", "yaml-cpp/yaml.h"},
      {"framework/scene/camera.cpp", "OpenImageIO/imageio.h"},
      {"framework/scene/camera.cpp", "tiny_obj_loader.h"},
      {"framework/scene/camera.cpp", "plugin/dataset.h"},
      {"framework/plugin/encoder.h", "Eigen/Core"},
      {"framework/execution/pipeline.h", "Eigen/Core"},
      {"framework/plugin/registry.cpp", "execution/pipeline.h"},
      {"framework/execution/pipeline.cpp", "encoders/hash_grid/hash_grid.h"},
      {"framework/execution/pipeline.cpp", "session/trainer.h"},
      {"framework/model/pass.h", "execution/pipeline.h"},
      {"framework/losses/photometric.cpp", "model/pass.h"},
      {"framework/losses/depth/depth.cpp", "cuda/kernels/loss_rays.cuh"},
      {"framework/session/trainer.cpp", "testkit/laws.h"},
      {"framework/session/trainer.cpp", "omp.h"},
      {"framework/surprise/new.cpp", "core/view.h"},
      {"framework/session/settings/run_config.cpp", "eval/evaluator.h"},
      {"framework/eval/evaluator.cpp", "session/session.h"},
      {"framework/session/session.cpp", "run/run_folder.h"},
      {"framework/run/train_run.cpp", "report/run_report.h"},
      {"framework/report/report.cpp", "surface/mesh/surface.h"},
      {"framework/surface/fuse/fusion.cpp", "report/report.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "encoders/frequency/frequency_math.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "scene/scene.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "config/config_tree.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "execution/pipeline.h"},
      {"plugins/encoders/hash_grid/hash_grid_math.h", "cuda_runtime.h"},
      {"plugins/datasets/replica/replica.cpp", "session/trainer.h"},
      {"plugins/losses/mine/mine.cpp", "losses/depth/depth.h"},
      {"plugins/losses/mine/mine.cpp", "losses/loss_list.h"},
      {"plugins/datasets/replica/replica.cpp", "OpenImageIO/imageio.h"},
      {"app/main.cpp", "encoders/hash_grid/hash_grid.h"},
      {"app/verb.h", "CLI/CLI.hpp"},
  };
  for (const Arrow& arrow : violations)
    EXPECT_NE(why_forbidden(arrow.path, arrow.target), "") << arrow.path << " -> " << arrow.target;
}

TEST(IncludeRules, KnownArrowsAreAllowed) {
  const Arrow allowed[] = {
      {"framework/config/config_tree.cpp", "yaml-cpp/yaml.h"},
      {"framework/compute/gemm.cpp", "Eigen/Core"},
      {"framework/execution/pipeline.cpp", "plugin/encoder.h"},
      {"framework/session/trainer.cpp", "execution/pipeline.h"},
      {"framework/losses/depth/depth_cuda.cu", "cuda/kernels/loss_rays.cuh"},
      {"framework/losses/depth/depth_test.cpp", "testkit/loss/loss_rays.h"},
      {"framework/testkit/laws.cpp", "session/trainer.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "plugin/encoder.h"},
      {"plugins/encoders/hash_grid/hash_grid.cpp", "encoders/hash_grid/hash_grid_math.h"},
      {"plugins/datasets/replica/replica.cpp", "loading/frame_files.h"},
      {"plugins/losses/mine/mine.cpp", "losses/mine/mine_math.h"},
      {"plugins/fused/hash_mlp/hash_mlp.cpp", "encoders/hash_grid/hash_grid_math.h"},
      {"plugins/encoders/hash_grid/hash_grid_test.cpp", "testkit/laws.h"},
      {"app/main.cpp", "session/trainer.h"},
  };
  for (const Arrow& arrow : allowed)
    EXPECT_EQ(why_forbidden(arrow.path, arrow.target), "") << arrow.path << " -> " << arrow.target;
}

TEST(IncludeRules, IncludesAreReadFromText) {
  const std::vector<Include> found =
      includes_of("// #include \"no.h\"\n#include <a/b.h>\n  #  include \"c.h\"\nint x;\n#define X \"y\"\n");
  ASSERT_EQ(found.size(), 2u);
  EXPECT_EQ(found[0].target, "a/b.h");
  EXPECT_EQ(found[0].line, 2);
  EXPECT_EQ(found[1].target, "c.h");
}

}  // namespace
}  // namespace semfield::architecture
