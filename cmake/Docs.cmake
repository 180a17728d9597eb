# The pages as a reader gets them, in build/PRESET/docs: those of the tree, with tables of the program's words and of data filled in, and
# docs/reference/{codes,cpp,plugins,python,verbs}.md, which only the build writes. Site, packages and the tests of pages take them from there.
find_package(Python3 COMPONENTS Interpreter)
if(NOT Python3_Interpreter_FOUND)
  return()
endif()
set(semfield_pages ${PROJECT_BINARY_DIR}/docs)
file(GLOB_RECURSE page_sources CONFIGURE_DEPENDS ${PROJECT_SOURCE_DIR}/docs/* ${PROJECT_SOURCE_DIR}/plugins/*.md ${PROJECT_SOURCE_DIR}/framework/*.h)
file(GLOB more_sources CONFIGURE_DEPENDS ${PROJECT_SOURCE_DIR}/*.md ${PROJECT_SOURCE_DIR}/cmake/*.py)
set(page_of_python "")
if(SEMFIELD_PYTHON AND NOT SEMFIELD_SANITIZE)  # the interpreter has no sanitizer
  set(page_of_python COMMAND ${CMAKE_COMMAND} -E env PYTHONPATH=${PROJECT_BINARY_DIR}/python ${Python_EXECUTABLE}
      ${PROJECT_SOURCE_DIR}/python/docs/reference.py ${semfield_pages}/docs/reference/python.md)
endif()
add_custom_command(OUTPUT ${semfield_pages}.made
  COMMAND ${Python3_EXECUTABLE} ${PROJECT_SOURCE_DIR}/cmake/make_pages.py ${semfield_pages}
  COMMAND semfield_app --quiet help --pages ${semfield_pages}
  ${page_of_python}
  COMMAND ${CMAKE_COMMAND} -E touch ${semfield_pages}.made
  DEPENDS semfield_app ${page_sources} ${more_sources} $<$<BOOL:${SEMFIELD_PYTHON}>:semfield_core>
  COMMENT "Pages")
add_custom_target(docs_pages ALL DEPENDS ${semfield_pages}.made)
include(GNUInstallDirs)
install(DIRECTORY ${semfield_pages}/ DESTINATION ${CMAKE_INSTALL_DOCDIR}/pages COMPONENT app PATTERN LICENSE EXCLUDE)
