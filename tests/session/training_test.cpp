// The public loop: two trainings in two threads, labels that change between steps, saving and going on, cancelling.

#include <thread>

#include "labels/clicks.h"
#include "tests/session/train_testing.h"
#include "train/assembly.h"

namespace semfield {
namespace {

using namespace testing_train;

RunConfig config_of(const std::string& yaml, Registry& registry = all_plugins()) {
  return run_config_of(parse_config_text(yaml, "test.yaml"), registry);
}

std::uint32_t bits_of(const Trainer& training) { return fingerprint(training.session().pipeline->store()); }

std::uint32_t bits_after(const std::string& yaml, std::int64_t steps) {
  Registry registry = make_registry();
  Trainer training(config_of(yaml, registry), registry);
  EXPECT_EQ(training.train(steps), steps);
  return bits_of(training);
}

// All that a training gives and reports, with the threads that its calls came from.
struct Told final : TrainingListener {
  std::uint32_t bits = 0;
  std::vector<std::string> notes, loading;
  std::vector<double> losses;  // after each step
  std::set<std::thread::id> from;

  void note(const std::string& text) override {
    from.insert(std::this_thread::get_id());
    notes.push_back(text);
  }
  void stepped(std::int64_t step, const StepLosses& made) override {
    from.insert(std::this_thread::get_id());
    EXPECT_EQ(step, std::ssize(losses) + 1);
    losses.push_back(made.total);
  }
};

void train_telling(const std::string& yaml, std::int64_t steps, Told& told) {
  Registry registry = make_registry();
  SessionOptions options;
  options.progress = [&told](std::string_view doing, std::size_t, std::size_t) {
    if (told.loading.empty() || told.loading.back() != doing) told.loading.emplace_back(doing);
  };
  Trainer training(config_of(yaml, registry), registry, options, &told);
  EXPECT_EQ(training.train(steps), steps);
  told.bits = bits_of(training);
}

TEST(Training, TwoInTwoThreadsGetTheBitsThatEachGetsAlone) {
  // Networks, scenes, threads, precision, limits and listeners differ: state of the process would show. The second
  // run's limits would refuse the first run's scene.
  std::string small = replaced(two_pass_config("runtime: {threads: 3, precision: bf16}\nlimits: {frames: 5}\n"),
                               "analytic_room", "analytic_room, frames: 5");
  std::string hash = replaced(hash_config("runtime: {threads: 2}\n"), "log2_entries: 11",
                              "log2_entries: 0");  // chosen from the scene, which is a note
  const std::string yamls[] = {hash, small};
  const std::int64_t steps[] = {40, 12};
  Told alone[2], together[2];
  for (int i = 0; i < 2; ++i) train_telling(yamls[i], steps[i], alone[i]);
  std::thread::id ids[2];
  std::vector<std::thread> threads;
  for (int i = 0; i < 2; ++i) {
    threads.emplace_back([&, i] {
      ids[i] = std::this_thread::get_id();
      train_telling(yamls[i], steps[i], together[i]);
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_NE(alone[0].notes, alone[1].notes) << "what one is told could be the other's";
  for (int i = 0; i < 2; ++i) {
    EXPECT_EQ(together[i].bits, alone[i].bits);
    EXPECT_EQ(together[i].losses, alone[i].losses);
    EXPECT_EQ(std::tie(together[i].notes, together[i].loading), std::tie(alone[i].notes, alone[i].loading));
    EXPECT_FALSE(alone[i].loading.empty());
    EXPECT_EQ(together[i].from, std::set<std::thread::id>{ids[i]});
  }
}

TEST(Training, TellsItsListenerAndObeysACancelAfterTheStep) {
  struct Listener final : TrainingListener {
    std::vector<std::int64_t> steps;
    std::function<void(std::int64_t)> then;
    void stepped(std::int64_t step, const StepLosses& losses) override {
      EXPECT_GT(losses.total, 0);
      steps.push_back(step);
      then(step);
    }
  } listener;
  Trainer training(config_of(hash_config()), all_plugins(), {}, &listener);
  listener.then = [&](std::int64_t step) {
    if (step == 4) training.cancel();
  };
  EXPECT_EQ(training.train(100), 4);
  EXPECT_EQ(training.step(), 4);
  EXPECT_EQ(training.train(2), 2) << "a cancel ends one call";
  EXPECT_EQ(listener.steps, (std::vector<std::int64_t>{1, 2, 3, 4, 5, 6}));
  training.cancel();
  EXPECT_EQ(training.train(5), 0) << "one that comes between calls ends the next";
  EXPECT_EQ(bits_of(training), bits_after(hash_config(), 6));
}

TEST(Training, RendersAndEvaluatesBetweenStepsWithoutAChange) {
  Trainer training(config_of(hash_config()), all_plugins());
  training.train(3);
  const FrameInfo& info = training.session().scene.info.frames.front();
  const RenderedFrame wide = training.render(info.camera.resized(20, 10), info.world_from_camera);
  EXPECT_EQ(wide.rgb.size(), 20U * 10U * 3U);
  EXPECT_EQ(wide.label.size(), 20U * 10U);
  const SplitScore score = training.evaluate(training.session().scene.frames_of(Split::test));
  EXPECT_EQ(score.frames.size(), 3U);
  EXPECT_TRUE(score.color.psnr_db().has_value());
  training.train(3);
  EXPECT_EQ(bits_of(training), bits_after(hash_config(), 6));
}

// The scene's labels of a frame, turned by one class among those that have a logit.
std::vector<std::int16_t> turned(const Trainer& training, int frame) {
  std::vector<std::int16_t> labels = training.session().scene.frames[frame].label.expand();
  const int classes = training.session().classes();
  for (std::int16_t& label : labels) {
    if (label != kVoid) label = static_cast<std::int16_t>((label + 1) % classes);
  }
  return labels;
}

std::string balanced(std::string yaml) {
  return replaced(std::move(yaml), "rays: 64}", "rays: 64, ray_source: label_balanced}");
}

class SetLabels : public testing::TestWithParam<std::string> {
 protected:
  std::unique_ptr<Trainer> open() { return std::make_unique<Trainer>(config_of(GetParam(), registry_), registry_); }
  // Labels of two frames change before step 4 and of one of them again before step 8.
  void change(Trainer& training) const {
    const std::vector<int> drawn = training.session().drawn_frames();
    if (training.step() == 4) {
      for (const int frame : {drawn[0], drawn[2]}) training.set_labels(frame, turned(training, frame));
    }
    if (training.step() == 8) {
      std::vector<std::int16_t> none = turned(training, drawn[0]);
      std::fill(none.begin() + 100, none.end(), kVoid);
      training.set_labels(drawn[0], std::move(none));
    }
  }
  void to(Trainer& training, std::int64_t step) const {
    while (training.step() < step) {
      change(training);
      training.advance();
    }
  }
  Registry registry_ = make_registry();
};
std::string name_of_way(const testing::TestParamInfo<std::string>& info) {
  return std::array{"as_configured", "label_balanced"}[info.index];
}
INSTANTIATE_TEST_SUITE_P(RaySources, SetLabels, testing::Values(two_pass_config(), balanced(two_pass_config())),
                         name_of_way);

TEST_P(SetLabels, TrainsOnThemAndResumesToTheSameBits) {
  const auto whole = open();
  to(*whole, 12);
  EXPECT_NE(bits_of(*whole), bits_after(GetParam(), 12)) << "the labels must show";

  const TempDir dir;
  const auto before = open();
  to(*before, 6);
  before->save(dir / "at_6.safetensors");
  const auto unset = open();
  const std::uint32_t fresh = bits_of(*unset);
  EXPECT_HAS(error_of(ErrorKind::data, [&] { unset->load(dir / "at_6.safetensors"); }),
             "call set_labels with the same labels before load");
  EXPECT_EQ(bits_of(*unset), fresh);
  EXPECT_EQ(unset->step(), 0);

  const auto after = open();
  const std::vector<int> drawn = after->session().drawn_frames();
  for (const int frame : {drawn[0], drawn[2]}) after->set_labels(frame, turned(*after, frame));
  after->load(dir / "at_6.safetensors");
  EXPECT_EQ(after->step(), 6);
  EXPECT_EQ(after->train_s(), before->train_s());
  to(*after, 12);
  EXPECT_EQ(bits_of(*after), bits_of(*whole));
}

TEST(Training, LabelsThatCannotTrainAreRefusedAndNothingChanges) {
  std::string yaml = replaced(two_pass_config(), "analytic_room}", "analytic_room, absent_class: 3}");
  Trainer training(config_of(yaml), all_plugins());
  const int frame = training.session().drawn_frames().front();
  const int test_frame = training.session().scene.frames_of(Split::test).front();
  std::vector<std::int16_t> labels(48 * 36, 0);
  const auto refusal = [&](int of, const std::vector<std::int16_t>& given) {
    return error_of(ErrorKind::data, [&] { training.set_labels(of, given); });
  };
  for (const int other : {test_frame, -1}) EXPECT_HAS(refusal(other, labels), "it is not a training frame");
  EXPECT_HAS(refusal(frame, {0, 1}), "2 values for 48 x 36 pixels");
  labels[50] = 5;
  EXPECT_HAS(refusal(frame, labels), "pixel x 2, y 1: 5 is not a class; there are 5");
  labels[50] = 3;
  EXPECT_HAS(refusal(frame, labels), "no label had class 'ball' when the session opened",
             "open it with runtime.keep: [semantics, absent_classes]");
  training.train(4);
  EXPECT_EQ(bits_of(training), bits_after(yaml, 4));

  // As the remedy says.
  Trainer kept(config_of(yaml + "runtime: {keep: [semantics, absent_classes]}\n"), all_plugins());
  kept.set_labels(frame, labels);
  EXPECT_EQ(kept.train(2), 2);
}

TEST(Training, TheLastLabelCannotBeTakenFromABalancedSource) {
  std::string yaml = replaced(balanced(two_pass_config()), "analytic_room}", "analytic_room, labels: {frames: 1}}");
  Trainer training(config_of(yaml), all_plugins());
  int labelled = -1;
  for (const int frame : training.session().drawn_frames()) {
    if (!training.session().labels.frames[frame].empty()) labelled = frame;
  }
  ASSERT_GE(labelled, 0);
  const std::string said =
      error_of(ErrorKind::data, [&] { training.set_labels(labelled, std::vector<std::int16_t>(48 * 36, kVoid)); });
  EXPECT_HAS(said, "no training pixel carries a label");
  training.train(3);
  EXPECT_EQ(bits_of(training), bits_after(yaml, 3));
}

// The shipped twin of the quickstart with frequency encodings keeps its density.

// A network that loses all density within its first hundred steps is refused by the trainer.
TEST(ShippedConfigurations, TheFrequencyTwinOfTheQuickstartTrainsPastItsFirstSteps) {
  if (all_plugins().find(PluginKind::dataset, "obj_room") == nullptr)
    GTEST_SKIP() << "this build casts no rays into meshes";
  for (const char* seed : {"runtime.seed=1", "runtime.seed=2"}) {
    RunConfig config = load_run_config(
        SEMFIELD_SOURCE_DIR "/configs/quickstart_frequency.yaml",
        {seed, "train.rays=128", "scene.frames=12", "scene.test_frames=2", "scene.width_px=48", "scene.height_px=36"},
        all_plugins());
    Trainer training(std::move(config), all_plugins());
    training.train(1);
    const double first = training.losses().total;
    EXPECT_EQ(training.train(129), 129) << seed;
    EXPECT_LT(training.losses().total, first) << seed;
  }
}

// Trainings whose labels come click by click: logits from the start, labels from the file, checkpoints before and
// after.

LabelEvent add(const std::string& id, const std::string& name) {
  return LabelEvent{.id = id, .kind = LabelEventKind::add_class, .class_name = name};
}

LabelEvent rename(const std::string& id, const std::string& from, const std::string& to) {
  return LabelEvent{.id = id, .kind = LabelEventKind::change_class, .class_name = from, .new_name = to};
}

LabelEvent undo(const std::string& id, const std::string& of) {
  return LabelEvent{.id = id, .kind = LabelEventKind::undo, .of = of};
}

LabelEvent click(const std::string& id, const std::string& frame, const std::string& name, PixelPoint at) {
  return LabelEvent{
      .id = id, .frame = frame, .width_px = 48, .height_px = 36, .points = {at}, .radius_px = 5, .class_name = name};
}

void write_log(const std::string& path, const std::vector<LabelEvent>& events) {
  std::string text;
  for (const LabelEvent& event : events) text += label_event_json(event) + "\n";
  write_file_atomic(path, text);
}

// The room without labels of its own, or with them and `labels` of the configuration.
std::string yaml_of(const std::string& labels, bool own = false) {
  const std::string bare = own ? "" : ", with_labels: false, with_classes: false";
  return balanced(with_scene(two_pass_config(), "{type: analytic_room" + bare + ", labels: {" + labels + "}}"));
}

struct Room {
  Registry registry = make_registry();
  TempDir dir;
  std::string log = dir / "clicks.jsonl";

  std::string first_frame() {
    const Session session = open_text(two_pass_config(), registry);
    return session.scene.info.frames[session.drawn_frames().front()].name;
  }
  std::unique_ptr<Trainer> open(const std::string& yaml) {
    return std::make_unique<Trainer>(config_of(yaml, registry), registry);
  }
  std::string refusal(const std::string& yaml) {
    return error_of([&] { (void)open(yaml); });
  }
};

std::string table_of(const Session& session) {
  std::string out;
  for (const ClassEntry& e : session.scene.info.classes.entries()) out += std::to_string(e.id) + "=" + e.name + " ";
  return out;
}

std::int64_t labelled_pixels(const Session& session) {
  std::int64_t count = 0;
  for (const std::vector<std::int64_t>& pixels : session.labels.class_pixels) {
    for (std::size_t c = 0; c + 1 < pixels.size(); ++c) count += pixels[c];
  }
  return count;
}

TEST(ClicksTraining, ASceneWithoutAnyLabelHasAllLogitsAndTrains) {
  Room room;
  const auto training = room.open(yaml_of("clicks: " + room.log + ", class_room: 4"));
  EXPECT_EQ(table_of(training->session()), "0=void 1=unnamed 1 2=unnamed 2 3=unnamed 3 4=unnamed 4 ");
  EXPECT_TRUE(training->session().plan.semantics);
  EXPECT_EQ(training->session().plan.class_of_logit, (std::vector<int>{0, 1, 2, 3}));
  EXPECT_EQ(training->session().config.runtime.keep, (std::vector<std::string>{"semantics", "absent_classes"}));
  EXPECT_EQ(labelled_pixels(training->session()), 0);
  EXPECT_EQ(training->train(3), 3);
  const SplitScore score = training->evaluate(training->session().scene.frames_of(Split::test));
  EXPECT_TRUE(score.color.psnr_db().has_value());
}

TEST(ClicksTraining, TheFilePaintsAlsoWithoutAnyLabelledFrame) {
  Room room;
  const std::string frame = room.first_frame();
  write_log(room.log, {add("1", "sofa"), click("2", frame, "sofa", {20, 10})});
  const auto training = room.open(yaml_of("frames: none, clicks: " + room.log, true));
  const Session& session = training->session();
  const int classes = open_text(two_pass_config(), room.registry).classes();
  EXPECT_EQ(session.classes(), classes + 1);
  EXPECT_EQ(session.scene.info.classes.valid(classes).name, "sofa");
  EXPECT_EQ(session.manifest.labelled_frames, 1);
  EXPECT_EQ(labelled_pixels(session), session.manifest.train_class_pixels.back());
  EXPECT_GT(labelled_pixels(session), 60);
  EXPECT_EQ(session.labels.frames[session.drawn_frames().front()][10 * 48 + 20], classes);
  EXPECT_EQ(training->train(2), 2);
}

TEST(ClicksTraining, AFileThatIsNotThereCountsOnlyWithRoom) {
  Room room;
  EXPECT_HAS(room.refusal(yaml_of("clicks: " + room.log, true)), room.log, "or directory");
  EXPECT_HAS(room.refusal(yaml_of("", false)), "no training pixel carries a label");
  write_log(room.log, {add("1", "sofa"), click("2", "no such frame", "sofa", {20, 10})});
  EXPECT_HAS(room.refusal(yaml_of("clicks: " + room.log, true)), "no such frame", "no frame");
}

TEST(ClicksTraining, LabelsThatComeSwitchTheBalancedSourceOn) {
  Room room;
  const std::string yaml = yaml_of("clicks: " + room.log + ", class_room: 3");
  const auto training = room.open(yaml);
  Annotations clicks = *training->session().config.labels.clicks;
  training->train(2);
  const int frame = training->session().drawn_frames().front();
  const std::string name = training->session().scene.info.frames[frame].name;
  clicks.apply(add("1", "sofa"));
  clicks.apply(click("2", name, "sofa", {20, 10}));
  training->set_clicks(clicks, std::vector<int>{frame});
  EXPECT_EQ(table_of(training->session()), "0=void 1=sofa 2=unnamed 2 3=unnamed 3 ");
  const auto rank = training->rays().choose(2, 1);
  EXPECT_EQ(rank.frame, 0) << "half of the rays go to the labelled pixels, all of one frame";
  training->advance();
  EXPECT_GT(training->losses().semantic, 0);
  // Undone again: as before the first click.
  clicks.apply(undo("3", "2"));
  training->set_clicks(clicks, std::vector<int>{frame});
  EXPECT_EQ(labelled_pixels(training->session()), 0);
  EXPECT_TRUE(training->session().labels.frames[frame].empty());
  training->advance();
  EXPECT_EQ(training->losses().semantic, 0);
}

TEST(ClicksTraining, ACheckpointFindsItsLabelsInTheFile) {
  // Click, save, more clicks in the file, load: no labels to set, other names are taken; the bits are those of a
  // training that was never stopped.
  Room room;
  const std::string yaml = yaml_of("clicks: " + room.log + ", class_room: 3");
  const std::string name = room.first_frame();
  std::vector<LabelEvent> events{add("1", "sofa"), click("2", name, "sofa", {20, 10})};
  const std::vector<LabelEvent> later{rename("3", "sofa", "couch"), add("4", "lamp"),
                                      click("5", name, "lamp", {30, 20})};
  const auto to_ten = [&](bool stop) {
    write_log(room.log, {});
    auto training = room.open(yaml);
    Annotations clicks = *training->session().config.labels.clicks;
    const int frame = training->session().drawn_frames().front();
    training->train(2);
    for (const LabelEvent& event : events) clicks.apply(event);
    training->set_clicks(clicks, std::vector<int>{frame});
    training->train(4);
    for (const LabelEvent& event : later) clicks.apply(event);
    if (stop) {
      training->save(room.dir / "at_6.safetensors");
      std::vector<LabelEvent> all = events;
      all.insert(all.end(), later.begin(), later.end());
      write_log(room.log, all);
      training = room.open(yaml);
      EXPECT_EQ(table_of(training->session()), "0=void 1=couch 2=lamp 3=unnamed 3 ");
      training->load(room.dir / "at_6.safetensors");
      EXPECT_EQ(training->step(), 6);
    } else {
      training->set_clicks(clicks, std::vector<int>{frame});
    }
    training->train(4);
    return bits_of(*training);
  };
  EXPECT_EQ(to_ten(true), to_ten(false));
}

TEST(ClicksTraining, ACheckpointWithoutTheFileThatNamedItsClassesIsRefused) {
  Room room;
  const std::string yaml = yaml_of("clicks: " + room.log + ", class_room: 3");
  write_log(room.log, {add("1", "sofa"), click("2", room.first_frame(), "sofa", {20, 10})});
  const auto training = room.open(yaml);
  training->train(1);
  training->save(room.dir / "at_1.safetensors");
  std::filesystem::remove(room.log);
  const auto bare = room.open(yaml);
  EXPECT_HAS(error_of([&] { bare->load(room.dir / "at_1.safetensors"); }), "sofa", "unnamed 1");
  EXPECT_EQ(bare->step(), 0);
}

TEST(ClicksTraining, ClicksOfAnotherSessionAreRefused) {
  Room room;
  const auto plain = room.open(yaml_of("", true));
  const auto clicked = room.open(yaml_of("class_room: 9", true));
  const Annotations& clicks = *clicked->session().config.labels.clicks;
  EXPECT_THROW(plain->set_clicks(clicks, std::vector<int>{plain->session().drawn_frames().front()}), Error);
  EXPECT_THROW(clicked->set_clicks(clicks, clicked->session().scene.frames_of(Split::test)), Error);
  EXPECT_NO_THROW(clicked->set_clicks(clicks, clicked->session().drawn_frames()));
}

TEST(ClicksTraining, WithoutTheKeysTheBitsAreThose) {
  // With a log of no events over labels of the scene, too.
  Room room;
  write_log(room.log, {});
  EXPECT_EQ(train_fingerprint(yaml_of("", true), 2, 4), train_fingerprint(yaml_of("clicks: " + room.log, true), 2, 4));
}

// --- class tables of checkpoints ---

std::string compared(const std::vector<LabelEvent>& then, const std::vector<LabelEvent>& now, int room_now = 3) {
  SceneInfo scene{.classes = ClassTable({{0, "void", {}, true}, {1, "wall", {}, false}})};
  const ClassTable before = replay(scene, 3, then, "then").classes();
  const std::optional<Annotations> clicks = replay(scene, room_now, now, "now");
  return error_of([&] { require_class_table(before.to_yaml(), clicks->classes(), clicks); });
}

TEST(TrainedClasses, NamesThatClicksGiveMayChange) {
  EXPECT_EQ(compared({}, {}), "");
  EXPECT_EQ(compared({}, {add("1", "sofa")}), "") << "named since";
  EXPECT_EQ(compared({add("1", "sofa")}, {add("1", "sofa"), rename("2", "sofa", "couch")}), "") << "renamed since";
  EXPECT_EQ(compared({add("1", "sofa")}, {add("1", "sofa"), undo("2", "1")}), "") << "undone since; it keeps its place";
  EXPECT_HAS(compared({add("1", "sofa")}, {}), "class 2 was 'sofa', and is 'unnamed 2' now");
  EXPECT_HAS(compared({}, {}, 4), "class 4 was not in the table, and is 'unnamed 4' now");
  EXPECT_HAS(compared({}, {}, 2), "class 3 was 'unnamed 3', and is not in the table now");
}

TEST(TrainedClasses, TheScenesOwnNamesMayNot) {
  SceneInfo scene{.classes = ClassTable({{0, "void", {}, true}, {1, "door", {}, false}})};
  const std::optional<Annotations> clicks = replay(scene, 3, {add("1", "sofa")}, "now");
  const auto compare_named = [&](const std::string& first, const std::string& second) {
    const std::string yaml = "[{id: 0, name: void, ignore: true}, {id: 1, name: " + first +
                             "}, {id: 2, name: " + second + "}, {id: 3, name: unnamed 3}]";
    return error_of([&] { require_class_table(yaml, clicks->classes(), clicks); });
  };
  EXPECT_EQ(compare_named("door", "x"), "");
  EXPECT_HAS(compare_named("wall", "x"), "class 1 was 'wall', and is 'door' now; restore");
  EXPECT_HAS(compare_named("door", "x, ignore: true"), "class 2 was 'x', ignored, and is 'sofa' now");
}

}  // namespace
}  // namespace semfield
