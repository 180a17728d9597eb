// Cases D05 and D07: batches without a label, and labels outside the class table.
#include <fmt/format.h>

#include <cstring>

#include "encoder_box.h"
#include "formats/image_io.h"
#include "loading/frame_files.h"
#include "loss_cases.h"
#include "losses/semantic_cross_entropy.h"
#include "training_box.h"

namespace semfield::numerics {

void all_void(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    constexpr std::int64_t kRays = 1024;
    constexpr std::int32_t kClasses = 28;
    Numbers numbers(51);
    std::vector<Real> logits;
    for (std::int64_t i = 0; i < kRays * kClasses; ++i) logits.push_back(static_cast<Real>(numbers.in(-5, 5)));
    const std::vector<std::int16_t> label(kRays, -1);
    const std::vector<float> soft(kRays * kClasses, 0.f), weights(kClasses, 2.f);
    for (const bool is_soft : {false, true}) {
      SemanticTargets targets;
      if (is_soft) {
        targets.soft = {soft.data(), kRays, kClasses};
      } else {
        targets.hard = {label.data(), kRays, 1};
      }
      for (const bool weighted : {false, true}) {
        const View<const float> class_weight = weighted ? row_of(weights) : View<const float>();
        for (const SemanticNormalisation kind :
             {SemanticNormalisation::mean_labelled, SemanticNormalisation::sum, SemanticNormalisation::mean_rays}) {
          const double normaliser = semantic_normaliser(kind, labelled_weight(targets, class_weight), kRays);
          std::vector<Real> gradient(logits.size(), Real(-9));
          const SemanticLoss loss =
              semantic_cross_entropy<Real>({logits.data(), kRays, kClasses}, targets, class_weight, normaliser, 1.0,
                                           {gradient.data(), kRays, kClasses});
          run.measure(std::abs(loss.sum), 0, "loss");
          run.expect(loss.labelled == 0 && loss.correct == 0, "no ray counts");
          const std::vector<Real> zeros(gradient.size(), Real(0));
          run.expect(std::memcmp(gradient.data(), zeros.data(), sizeof(Real) * zeros.size()) == 0,
                     "every gradient is +0, bit by bit");
        }
      }
    }
  });
  run.row("fp32");
  // Training on few labels: 4 rays per step and one labelled frame, so about half of the batches hold no label. In such
  // a step the head is not touched: neither its values nor its moments, which an update with gradient 0 would move and
  // decay.
  TrainingBox box(run.registry(), small_config("scene: {type: box_room, labels: {frames: 1}}\n"
                                               "semantics: {hidden_width: 16, weight: 0.3}\n"
                                               "train: {steps: 50, rays: 4}\n"));
  int with = 0, without = 0;
  for (int step = 0; step < 40; ++step) {
    const std::vector<TrainingBox::Kept> before = box.state();
    const StepLosses losses = box.trainer().advance();
    const std::vector<TrainingBox::Kept> after = box.state();
    ++(losses.labelled == 0 ? without : with);
    if (losses.labelled == 0) run.measure(std::abs(losses.semantic), 0, "semantic loss of a step without labels");
    bool others_moved = false, head_moved = false;
    for (std::size_t i = 0; i < before.size(); ++i) {
      const bool moved = !(before[i] == after[i]);
      const bool head =
          before[i].name.find("/head/") != std::string::npos || before[i].name.find("semantic") != std::string::npos;
      (head ? head_moved : others_moved) |= moved;
    }
    run.expect(others_moved, "the colour network learns from every step");
    run.expect(head_moved == (losses.labelled > 0), "the head moves in steps with labels alone");
  }
  run.expect(with >= 5 && without >= 5, "both kinds of step occurred");
  run.note(fmt::format("{} of 40 steps without a label", without));
}

void label_range(CaseRun& run) {
  in_both_precisions(run, [&]<class Real>(Real) {
    const std::vector<Real> logits(28 * 3, Real(1));
    std::vector<Real> gradient(28 * 3);
    const std::vector<float> weights(28, 1.f);
    for (const int bad : {28, -2, 255, 32767, -32768}) {
      const std::vector<std::int16_t> label{27, static_cast<std::int16_t>(bad), -1};
      SemanticTargets targets{.hard = {label.data(), 3, 1}};
      run.expect_error(ErrorKind::data, {"ray 1001 ", fmt::format("is {};", bad), "0 to 27"}, [&] {
        semantic_cross_entropy<Real>({logits.data(), 3, 28}, targets, {}, 1.0, 1.0, {gradient.data(), 3, 28}, 1000);
      });
      if (bad > 0)
        run.expect_error(ErrorKind::data, {"ray 1 ", fmt::format("is {};", bad)},
                         [&] { labelled_weight(targets, row_of(weights)); });
    }
  });
  // Where labels enter: an image whose pixel (3, 2) holds an id that no class has. 65535 must not become void, -1.
  run.row("-");
  std::vector<ClassEntry> entries;
  for (int c = 0; c < 28; ++c) entries.push_back({c + 1, "class " + std::to_string(c), {}, false});
  const ClassTable classes(entries);
  FrameInfo frame{.name = "view_7", .camera = {.width_px = 6, .height_px = 4}};
  FrameFiles files{run.folder() + "/color.png", "", run.folder() + "/label.png", ""};
  write_png_rgb(files.color, 6, 4, std::vector<std::uint8_t>(72, 100));
  for (const int bad : {0, 29, 255, 65534, 65535}) {
    std::vector<std::uint16_t> ids(24, 5);
    ids[2 * 6 + 3] = static_cast<std::uint16_t>(bad);
    write_png_gray16(files.label, 6, 4, ids);
    FrameBuffer buffer;
    run.expect_error(ErrorKind::data, {"frame 'view_7'", "label.png", fmt::format("id {} ", bad), "x 3", "y 2"},
                     [&] { read_frame_files(frame, files, {}, classes, buffer); });
    FrameReadRules lenient{.unknown_labels = UnknownLabels::as_void};
    read_frame_files(frame, files, lenient, classes, buffer);
    run.expect(buffer.label[15] == kVoid && buffer.label[14] == 4, "unknown_labels: void makes it void, and it alone");
  }
  // Where a batch is made: a label that got into memory by another way.
  for (const int bad : {28, -2, 255, 32767}) {
    StoredFrame pixels;
    pixels.width_px = 6;
    pixels.height_px = 4;
    pixels.rgb.assign(72, 100);
    std::vector<std::int16_t> label(24, 5);
    label[15] = static_cast<std::int16_t>(bad);
    TrainingLabels::Frame labels;
    labels.hard = LabelMap(label);
    TrainFrame train{{frame.camera, Pose{}, false}, &pixels, &labels, frame.name};
    train.camera.camera.fx = train.camera.camera.fy = 5;
    std::vector<std::int16_t> logit_of_class;
    for (std::int16_t c = 0; c < 28; ++c) logit_of_class.push_back(c);
    RaySourceOptions options;
    options.train.rays = 256;  // of 24 pixels: the bad one is among them
    const RaySource source({train}, logit_of_class, {}, options);
    BatchBuffers batch;
    run.expect_error(ErrorKind::data, {"frame 'view_7'", "x 3, y 2", fmt::format("label {} ", bad)},
                     [&] { source.fill(0, batch); });
  }
}

}  // namespace semfield::numerics
