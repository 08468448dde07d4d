
    // A control named "FOLDER: NAME" is placed in a folder; the first control opens the panel.
    const drakeOaAdd = viewer.set_control.bind(viewer);
    viewer.set_control = (name, ...rest) => {
      const gui = viewer.gui, [folder, label] = name.split(": ");
      gui.width = 320;
      gui.open();
      gui.__folders["Scene"].close();
      if (label) viewer.gui = gui.__folders[folder] || gui.addFolder(folder);
      drakeOaAdd(name, ...rest);
      viewer.gui = gui;
      if (label) viewer.gui_controllers[name].name(label);
    };
