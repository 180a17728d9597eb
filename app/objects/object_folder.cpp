#include "app/objects/object_folder.h"

#include <fmt/format.h>
#include <sys/stat.h>

#include <cerrno>
#include <chrono>
#include <exception>
#include <filesystem>
#include <thread>

#include "app/objects/object_tables.h"
#include "core/error.h"
#include "system/files.h"

namespace semfield::app {

namespace {

constexpr double kEditWait_s = 10;  // another edit takes a fraction of a second

// A file that was written anew has another one.
std::string stamp_of_file(const std::string& path) {
  struct stat about {};
  if (::stat(path.c_str(), &about) != 0) return "-";
  return fmt::format("{}:{}:{}.{}", about.st_ino, about.st_size, about.st_mtim.tv_sec, about.st_mtim.tv_nsec);
}

}  // namespace

FolderLock hold_objects(const std::string& folder, double wait_s) {
  const auto end = std::chrono::steady_clock::now() + std::chrono::duration<double>(wait_s);
  FolderLock lock;
  for (;;) {
    const int cause = lock.take(folder);
    if (cause == 0) return lock;
    if (cause != EWOULDBLOCK) throw write_error("write in", folder, cause);
    if (std::chrono::steady_clock::now() >= end)
      throw Error(ErrorKind::cannot_create, "objects.folder.busy",
                  fmt::format("the objects in '{}' are being changed by {}", folder, lock.holder()),
                  "wait until it has ended");
    std::this_thread::sleep_for(std::chrono::milliseconds(20));
  }
}

std::string ObjectFolder::file(const char* name) const { return (std::filesystem::path(folder_) / name).string(); }

const EditedObjects* ObjectFolder::look() {
  const std::string stamp = stamp_of_file(file("found.safetensors")) + " " + stamp_of_file(file("edits.json"));
  if (stamp != stamp_) {
    read_.reset();
    stamp_.clear();
    if (!stamp.starts_with("-")) {
      EditedObjects now = read_edited_objects(folder_, info_.classes.valid_count());
      if (!now.set.rows.empty()) read_ = std::move(now);
    }
    stamp_ = stamp;  // older than what was read where another program has just written: then it is read again
  }
  return read_ ? &*read_ : nullptr;
}

std::string ObjectFolder::state() const { return read_ ? objects_state(read_->edits) : std::string(); }

const EditedObjects& ObjectFolder::edit(const std::optional<ObjectEdit>& edit, const std::string& state) {
  if (look() == nullptr)
    throw Error(ErrorKind::data, "view.objects.none", folder_ + ": no objects were found in this run",
                "find them: semfield objects");
  const FolderLock alone = hold_objects(folder_, kEditWait_s);
  if (look() == nullptr || this->state() != state)
    throw Error(ErrorKind::data, "objects.edit.stale",
                "the objects were changed meanwhile, by another page or program; nothing was saved",
                "load the page again");
  EditedObjects next;
  next.edits = read_->edits;
  if (edit) {
    next.set = read_->set;
    apply_edit(next.set, *edit);
    next.edits.edits.push_back(*edit);
  } else {
    if (next.edits.edits.empty()) throw Error(ErrorKind::data, "view.undo.none", "there is no edit to take back", "");
    next.edits.edits.pop_back();
    next.set = read_object_set(file("found.safetensors"), info_.classes.valid_count());
    apply_edits(next.set, next.edits, file("edits.json"));
  }
  write(std::move(next));
  return *read_;
}

void ObjectFolder::write(EditedObjects next) {
  const std::string text = object_edits_text(next.edits);
  AtomicFile edits(file("edits.json"));
  edits.append(std::as_bytes(std::span<const char>(text.data(), text.size())));
  try {
    write_object_tables(folder_, next, info_);
    edits.commit();  // last: what could fail has not
  } catch (const std::exception&) {
    try {
      write_object_tables(folder_, *read_, info_);
    } catch (const std::exception&) {  // of the same cause; mend() does it when the run is opened again
      stamp_.clear();
    }
    throw;
  }
  read_ = std::move(next);
  stamp_ = stamp_of_file(file("found.safetensors")) + " " + stamp_of_file(file("edits.json"));
}

void ObjectFolder::mend() {
  const auto is_whole = [&] { return look() == nullptr || tables_state(folder_, read_->edits) == state(); };
  if (is_whole()) return;
  const FolderLock alone = hold_objects(folder_, kEditWait_s);
  if (!is_whole()) write_object_tables(folder_, *read_, info_);
}

}  // namespace semfield::app
