// Finds and loads the library of image_formats.h beside the one that this file is part of.
#include <dlfcn.h>

#include <filesystem>

#include "core/error.h"
#include "scene/image_formats.h"

namespace semfield {

#ifdef SEMFIELD_WITH_IMAGES

namespace {

const ImageFormats& load() {
  Dl_info self{};
  ::dladdr(reinterpret_cast<const void*>(&image_formats), &self);
  const std::filesystem::path folder =
      self.dli_fname != nullptr ? std::filesystem::path(self.dli_fname).parent_path() : std::filesystem::path();
  const std::string path = (folder / SEMFIELD_IMAGES_LIBRARY).string();
  void* library = ::dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL);
  void* symbol = library != nullptr ? ::dlsym(library, kImageFormatsSymbol) : nullptr;
  if (symbol == nullptr) {
    throw Error(ErrorKind::unavailable, std::string("images other than PNG cannot be read: ") + ::dlerror(),
                "install Semfield again, or convert the images to PNG");
  }
  return *reinterpret_cast<const ImageFormats* (*)()>(symbol)();
}

}  // namespace

bool images_available() { return true; }

const ImageFormats& image_formats() {
  static const ImageFormats& formats = load();  // tried again where it failed
  return formats;
}

#else

bool images_available() { return false; }

const ImageFormats& image_formats() {
  throw Error(ErrorKind::unavailable, "this build reads PNG images only",
              "build with -DSEMFIELD_WITH_IMAGES=ON, or pack the scene elsewhere");
}

#endif

}  // namespace semfield
