// A program of another project that trains: five steps, scores, a picture, a checkpoint, and the same again from there.
// Usage: drive FOLDER_OF_MODULES.
#include <cstdio>

#include "config/config_tree.h"
#include "plugin/loader.h"
#include "train/trainer.h"

namespace {

constexpr const char* kConfig =
    "scene: {type: corridor}\n"
    "semantics: {hidden_width: 16}\n"
    "passes:\n"
    "  - sampler: {type: stratified, samples: 16}\n"
    "    position: {type: hash_grid, levels: 4, log2_entries: 10, finest_resolution: 64}\n"
    "    direction: {type: spherical_harmonics, degree: 2}\n"
    "    field: {type: tiny_mlp, hidden_width: 16, color_width: 16}\n"
    "train: {rays: 64}\n";

struct Printer final : semfield::TrainingListener {
  void note(const std::string& text) override { std::printf("note: %s\n", text.c_str()); }
  void stepped(std::int64_t step, const semfield::StepLosses& losses) override {
    std::printf("step %lld: loss %.4f\n", static_cast<long long>(step), losses.total);
  }
};

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  try {
    const std::string folder = argv[1];
    semfield::Registry registry;
    semfield::register_linked_plugins(registry);
    semfield::load_module(registry, folder + "/corridor.so");
    Printer printer;
    const auto open = [&] {
      return semfield::run_config_of(semfield::parse_config_text(kConfig, "drive.cpp"), registry);
    };
    semfield::Trainer training(open(), registry, {}, &printer);
    if (training.train(3) != 3) return 1;
    training.save(folder + "/drive.safetensors");
    if (training.train(2) != 2) return 1;
    const semfield::FrameInfo& frame = training.session().scene.info.frames.front();
    const semfield::RenderedFrame picture = training.render(frame.camera, frame.world_from_camera);
    const semfield::SplitScore score = training.evaluate({0});
    std::printf("%d x %d pixels, PSNR %.2f dB\n", picture.width_px, picture.height_px, *score.color.psnr_db());

    semfield::Trainer again(open(), registry);
    again.load(folder + "/drive.safetensors");
    if (again.train(2) != 2) return 1;
    const bool same = again.losses().total == training.losses().total;
    std::printf("resumed at step 3: %s\n", same ? "the same loss" : "ANOTHER LOSS");
    return same ? 0 : 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return 1;
  }
}
